// XML-RPC with npm's xmlrpc: node xml_rpc.js PORT
"use strict";

const assert = require("node:assert");
const xmlrpc = require("xmlrpc");
const { client, until, RELEASE_KEY, DONE } = require("./common.js");

client("XML-RPC", async (print) => {
  const link = xmlrpc.createClient({ host: "127.0.0.1", port: Number(process.argv[2]), path: "/RPC2" });
  const call = (method, ...given) =>
    new Promise((done, failed) =>
      link.methodCall(method, given, (error, value) => (error ? failed(error) : done(value))),
    );
  const lease = await until("lease", async () => {
    const found = await call("acquire", "npm xmlrpc");
    return found > 0 && found;
  });
  const done = async (job) => {
    assert.ok(job > 0, `refused with ${-job}`);
    await until("job", async () => {
      await call("alive", lease);
      return (await call("job_state", job)) >= DONE;
    });
    assert.equal(await call("job_state", job), DONE);
    return job;
  };
  const job = await done(await call("identify", lease, 0, 0, true));
  print("label", await call("label", job));
  print("probability", await call("probability", job));
  print("state", await call("state"));
  print("a release without its key", await call("release", lease, 0));
  assert.equal(await call("holding"), true);
  await done(await call("release", lease, RELEASE_KEY));
  print("fault number", await call("fault_number"));
  print("state after release", await call("state"));
  assert.deepEqual([await call("fault_number"), await call("state")], [0, 4]);
  await call("give_up", lease);
});
