// Modbus TCP with npm's modbus-serial in command, and mbpoll as a second client that may only read.
// node modbus.js PORT LABEL...: labels in the order of their ids
"use strict";

const assert = require("node:assert");
const { spawnSync } = require("node:child_process");
const Modbus = require("modbus-serial");
const { client, until, RELEASE_KEY, DONE } = require("./common.js");

const [port, ...labels] = process.argv.slice(2);
const [IDENTIFY, RELEASE, KEEP] = [21, 30, 1];

const mbpoll = (...options) =>
  spawnSync("mbpoll", ["-0", "-1", "-q", "-p", port, "127.0.0.1", ...options], { encoding: "utf8" });

// Input registers as mbpoll prints them: "[10]: \t4".
const polled = (first, count) => {
  const { status, stdout, stderr } = mbpoll("-t", "3", "-r", String(first), "-c", String(count));
  assert.equal(status, 0, stderr);
  return [...stdout.matchAll(/^\[\d+\]:\s+(-?\d+)/gm)].map((line) => Number(line[1]));
};

client("Modbus", async (print) => {
  const plc = new Modbus();
  await plc.connectTCP("127.0.0.1", { port: Number(port) });
  plc.setTimeout(20000);
  const inputs = async () => (await plc.readInputRegisters(0, 64)).data;
  let life = 0;
  const alive = () => plc.writeRegister(0, (life = (life + 1) & 0xffff));
  await until("lease", () => alive().then(() => true, () => false));
  let seq = (await inputs())[5];
  await plc.writeRegister(8, seq);

  // Write a command in one block, wait until it is acknowledged and its job is over.
  const command = async (number, { options = 0, key = 0 } = {}) => {
    seq = (seq + 1) & 0xffff;
    life = (life + 1) & 0xffff;
    await plc.writeRegisters(0, [life, number, 0, 0, 0, options, key, 0, seq]);
    const now = await until("acknowledged", async () => {
      const found = await inputs();
      return found[5] === seq && found;
    });
    assert.equal(now[6], 0, `command ${number} is refused with ${now[6]}`);
    return until("job", async () => {
      await alive();
      const found = await inputs();
      return found[9] >= DONE && found;
    });
  };

  print("signature", (await inputs())[0].toString(16));
  const named = await command(IDENTIFY, { options: KEEP });
  print("label", labels[named[10] - 1]);
  print("probability", named[11] / 1e4);
  print("state", named[3]);
  const seen = polled(0, 16);
  print("mbpoll: label", labels[seen[10] - 1]);
  print("mbpoll: fault number", seen[7]);
  assert.deepEqual([seen[0], seen[3], seen[10]], [0x5443, 17, named[10]]);
  const other = mbpoll("-t", "4", "-r", "0", String(life + 7), "30");
  print("mbpoll: a second master", other.stderr.trim().split("\n").pop());
  assert.notEqual(other.status, 0);
  const released = await command(RELEASE, { key: RELEASE_KEY });
  print("fault number", released[7]);
  print("state after release", released[3]);
  assert.deepEqual([released[7], released[3]], [0, 4]);
  plc.close();
});
