// OPC UA with npm's node-opcua-client: node opc_ua.js PORT FOLDER
// FOLDER is that of the cell's certificates; the client's own are made beside it, and trusted there.
"use strict";

const assert = require("node:assert");
const fs = require("node:fs");
const path = require("node:path");
const ua = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager"); // comes with it
const { client, until, RELEASE_KEY, DONE } = require("./common.js");

const [port, folder] = process.argv.slice(2);
const url = `opc.tcp://127.0.0.1:${port}/`;
const quick = { maxRetry: 0, initialDelay: 100 };
const text = (value) => ({ dataType: ua.DataType.String, value });
const int = (value) => ({ dataType: ua.DataType.Int32, value });
const real = (value) => ({ dataType: ua.DataType.Double, value });
const yes = (value) => ({ dataType: ua.DataType.Boolean, value });

// Open a session, use it, close it.
const session = async (options, use) => {
  const link = ua.OPCUAClient.create({ endpointMustExist: false, connectionStrategy: quick, ...options });
  try {
    await link.connect(url);
    const opened = await link.createSession(options.user);
    const names = await opened.readNamespaceArray();
    const space = names.indexOf("urn:tactile-cell:cell");
    const id = (name) => `ns=${space};s=Cell${name && "."}${name}`;
    try {
      return await use({
        opened,
        id,
        read: async (name) => (await opened.read({ nodeId: id(name) })).value.value,
        call: (name, ...inputArguments) =>
          opened.call({ objectId: id(""), methodId: id(name), inputArguments }),
      });
    } finally {
      await opened.close();
    }
  } finally {
    await link.disconnect();
  }
};

const refused = (asked) => asked.then(() => "not refused", (error) => (error.message.match(/Bad\w+/) ?? [error.message])[0]);

client("OPC UA", async (print) => {
  // Both holes of the library behind the cell, tried by a client that is none of its own.
  await session({}, async (cell) => {
    print("anonymous: state", await cell.read("State.Name"));
    const asked = await cell.call("acquire", text("nobody")).catch((error) => error);
    print("anonymous: a call", (asked.message ?? asked.statusCode.toString()).match(/Bad\w+/)[0]);
    const wrote = await cell.opened
      .write({ nodeId: cell.id("State.Name"), attributeId: ua.AttributeIds.Value, value: { value: text("RUN") } })
      .catch((error) => error);
    print("anonymous: a write", (wrote.message ?? wrote.toString()).match(/Bad\w+/)[0]);
    assert.equal(await cell.read("State.Commander"), "");
  });
  const user = { type: ua.UserTokenType.UserName, userName: "admin", password: "any" };
  print("admin with any password", await refused(session({ user }, async () => {})));

  // A certificate of its own, then put into the trust list.
  const certificates = new OPCUACertificateManager({
    rootFolder: path.join(folder, "..", "client"),
    automaticallyAcceptUnknownCertificate: true,
  });
  await certificates.initialize();
  const certificateFile = path.join(folder, "..", "client", "own.pem");
  await certificates.createSelfSignedCertificate({
    outputFile: certificateFile,
    subject: "/CN=client",
    applicationUri: "urn:client",
    dns: ["localhost"],
    startDate: new Date(),
    validity: 30,
  });
  const secure = {
    applicationUri: "urn:client",
    clientCertificateManager: certificates,
    certificateFile,
    privateKeyFile: certificates.privateKey,
    securityMode: ua.MessageSecurityMode.SignAndEncrypt,
    securityPolicy: ua.SecurityPolicy.Basic256Sha256,
  };
  print("not in the trust list", await refused(session(secure, async () => {})));
  fs.copyFileSync(certificateFile, path.join(folder, "trusted", "client.pem"));

  await session(secure, async (cell) => {
    const result = async (name, ...given) => {
      const answer = await cell.call(name, ...given);
      assert.ok(answer.statusCode.isGood(), `${name}: ${answer.statusCode}`);
      return answer.outputArguments[0].value;
    };
    const lease = await until("lease", async () => {
      const found = await result("acquire", text("node-opcua"));
      return found > 0 && found;
    });
    const done = async (job) => {
      assert.ok(job > 0, `refused with ${-job}`);
      await until("job", async () => {
        await result("alive", int(lease));
        return (await cell.read("Job.Number")) === job && (await cell.read("Job.State")) >= DONE;
      });
    };
    await done(await result("identify", int(lease), int(0), real(0), yes(true), int(0)));
    print("label", await cell.read("Job.Label"));
    print("probability", await cell.read("Job.Probability"));
    print("shape and size", [await cell.read("Job.Shape"), await cell.read("Job.Size")]);
    print("taxels", (await cell.read("Taxels")).length);
    await until("state", async () => (await cell.read("State.Number")) === 17);
    print("state", await cell.read("State.Number"));
    await done(await result("release", int(lease), int(RELEASE_KEY), int(0)));
    await until("state", async () => (await cell.read("State.Number")) === 4);
    print("fault number", await cell.read("FaultNumber"));
    print("state after release", await cell.read("State.Number"));
    await result("give_up", int(lease));
  });
});
