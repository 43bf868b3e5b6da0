// HTTP with the fetch of Node.js: node http.js PORT TOKEN
"use strict";

const assert = require("node:assert");
const { client, until, RELEASE_KEY, DONE } = require("./common.js");

const [port, token] = process.argv.slice(2);

client("HTTP", async (print) => {
  const ask = async (method, path, body, headers = { Authorization: `Bearer ${token}` }) => {
    const answer = await fetch(`http://127.0.0.1:${port}/api/${path}`, {
      method,
      headers: { "Content-Type": "application/json", ...headers },
      body: body && JSON.stringify(body),
    });
    return { code: answer.status, ...(await answer.json()) };
  };
  const { lease } = await until("lease", async () => {
    const found = await ask("POST", "lease", { name: "node fetch" });
    return found.code === 200 && found;
  });
  const done = async ({ job, error }) => {
    assert.ok(job > 0, error);
    return until("job", async () => {
      await ask("POST", `lease/${lease}/alive`);
      const found = await ask("GET", `jobs/${job}`);
      return found.outcome_number >= DONE && found;
    });
  };
  const named = await done(await ask("POST", "jobs", { lease, goal: { task: "identify", keep: "always" } }));
  print("label", named.label);
  print("probability", named.probability);
  print("state", (await ask("GET", "state")).status.state_number);
  print("without the token", (await ask("GET", "state", undefined, {})).code);
  await done(await ask("POST", "commands", { lease, command: "release", key: RELEASE_KEY }));
  const after = (await ask("GET", "state")).status;
  print("fault number", after.fault_number);
  print("state after release", after.state_number);
  assert.deepEqual([named.outcome_number, after.fault_number, after.state_number], [DONE, 0, 4]);
  await ask("DELETE", `lease/${lease}`);
});
