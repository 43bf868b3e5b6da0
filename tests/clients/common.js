// What the clients share: waiting, the parts that come in turn, and what is printed.
"use strict";

exports.RELEASE_KEY = 0x4f50;
exports.DONE = 4; // job_state of a job that is done

exports.sleep = (ms) => new Promise((done) => setTimeout(done, ms));

// Ask again and again until the answer is true, and return it.
exports.until = async (what, ask, limitMs = 60000) => {
  const end = Date.now() + limitMs;
  for (;;) {
    const found = await ask();
    if (found) return found;
    if (Date.now() > end) throw new Error(`${what}: not within ${limitMs} ms`);
    await exports.sleep(50);
  }
};

// Run a client and print each result as a line; any error ends with exit code 1.
exports.client = (name, walk) => {
  const print = (key, value) => console.log(`${name}: ${key} = ${JSON.stringify(value)}`);
  walk(print).then(
    () => process.exit(0),
    (error) => {
      console.error(`${name}: FAILED`, error);
      process.exit(1);
    },
  );
};
