// The connection with the cell: newest states and frames; each command is carried out once.

const STALE_S = 1; // an older state is not live
const RENEW_S = 2.5; // connect again after this time without a message
const LATE_S = 10; // connect again after this time with late messages only
const MEASURE_S = 2; // least time between two comparisons of the clocks
const TRY_S = 3; // a command without an answer is repeated for this time
const ANSWER_MS = 1500; // longest wait for one answer

export class Refused extends Error {
  constructor(status, answer) {
    super(answer?.error ?? answer?.detail ?? String(status));
    this.status = status;
    this.number = answer?.fault_number ?? 0;
    this.remedy = answer?.remedy ?? "";
  }
}
export class NoAnswer extends Error {}

const wait = (ms) => new Promise((go) => setTimeout(go, ms));
const now_s = () => Date.now() / 1000;

export class Link {
  // `on` has: state(state), frame(Float32Array), connected(), refused(), lost().
  constructor(on) {
    this.on = on;
    this.token = keptToken();
    // A browser copies the storage to a duplicate of the page: so name and lease are stored only
    // while this page is unloaded.
    const own = JSON.parse(sessionStorage.getItem("own") ?? "{}");
    this.name = own.name ?? `page-${Math.floor(0x1000 + Math.random() * 0xefff).toString(16)}`;
    this.lease = own.lease ?? 0;
    sessionStorage.removeItem("own");
    window.addEventListener("pageshow", () => sessionStorage.removeItem("own"));
    window.addEventListener("pagehide", () => {
      sessionStorage.setItem("own", JSON.stringify({ name: this.name, lease: this.lease }));
    });
    this.leaseTimeout_s = 2;
    this.viewOnly = false;
    this.state = null;
    this.pending = false;
    this.heard_s = 0;
    this.offset_s = Infinity;
    this.lag_s = 0;
    this.lateSince_s = 0;
    this.measured_s = 0;
    this.socket = null;
    this.begun_s = 0;
    this.delay_ms = 250;
    this.aliveDue_s = 0;
    setInterval(() => this.look(), 250);
    document.addEventListener("visibilitychange", () => {
      if (!document.hidden) this.look();
    });
    window.addEventListener("online", () => this.renew());
  }

  // Age in s of the shown values: time since the last message, plus the delay of that message.
  get age_s() {
    return this.heard_s ? Math.max(now_s() - this.heard_s, this.lag_s) : Infinity;
  }

  get stale() {
    return this.age_s > STALE_S;
  }

  // Whether this page is in command, according to the cell.
  get commands() {
    return this.lease !== 0 && this.state?.commander === this.name && !this.stale;
  }

  url(path) {
    return new URL(path, document.baseURI);
  }

  connect() {
    this.drop();
    // Also the whole address; a character that no token has would make the constructor throw.
    this.token = this.token.split("token=").at(-1).replace(/[^\w.~-]/g, "-");
    const url = this.url("api/live?frames=newtons");
    url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    this.begun_s = now_s();
    this.offset_s = Infinity;
    this.lag_s = 0;
    this.lateSince_s = 0;
    const socket = new WebSocket(url, ["tactile-cell", `token.${this.token}`]);
    socket.binaryType = "arraybuffer";
    let first = true;
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return;
      if (typeof data !== "string") {
        this.on.frame(new Float32Array(data));
        return;
      }
      this.take(JSON.parse(data));
      if (first) {
        first = false;
        this.delay_ms = 250;
        this.on.connected();
      }
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.socket = null;
      this.askWhy();
    };
    this.socket = socket;
  }

  take(state) {
    const now = now_s();
    this.state = state;
    this.heard_s = now;
    if (state.time_s !== undefined) {
      // Bound of the clocks' difference: from the fastest message of this connection.
      this.offset_s = Math.min(this.offset_s, now - state.time_s);
      this.lag_s = now - state.time_s - this.offset_s;
      if (this.lag_s > STALE_S / 2 || this.measured_s < this.begun_s) this.measure();
    }
    this.lateSince_s = this.lag_s > STALE_S ? this.lateSince_s || now : 0;
    this.keepLease();
    this.on.state(state);
  }

  // The difference of the clocks, from the middle of a request: it reveals a line that is always
  // slow, and a clock that was set.
  async measure() {
    const begin_s = now_s();
    if (begin_s - this.measured_s < MEASURE_S) return;
    this.measured_s = begin_s;
    try {
      const { time_s } = await this.call("GET", "api/state", { timeout_ms: 8000 });
      this.offset_s = (begin_s + now_s()) / 2 - time_s;
    } catch { /* the next message asks again */ }
  }

  drop() {
    const old = this.socket;
    this.socket = null;
    old?.close();
  }

  renew() {
    if (!this.stopped) this.connect();
  }

  // Messages wake a page that the browser has suspended; this timer handles missing messages.
  look() {
    const now = now_s();
    this.keepLease();
    const silent = this.socket && now - Math.max(this.heard_s, this.begun_s) > RENEW_S;
    if (silent || (this.lateSince_s && now - this.lateSince_s > LATE_S)) this.renew();
  }

  async askWhy() {
    try {
      await this.call("GET", "api/info");
    } catch (error) {
      if (error instanceof Refused && error.status === 401) {
        this.stopped = true;
        this.on.refused();
        return;
      }
    }
    await wait(this.delay_ms);
    this.delay_ms = Math.min(2 * this.delay_ms, 2000);
    if (!this.socket && !this.stopped) this.connect();
  }

  login(token) {
    this.token = token;
    sessionStorage.setItem("token", token);
    this.stopped = false;
    this.connect();
  }

  // -- requests -----------------------------------------------------------------------------------

  async call(method, path, { body, timeout_ms = ANSWER_MS } = {}) {
    const headers = { Authorization: `Bearer ${this.token}` };
    if (body !== undefined) headers["Content-Type"] = "application/json";
    let answer;
    try {
      answer = await fetch(this.url(path), {
        method,
        headers,
        body: JSON.stringify(body),
        cache: "no-store",
        signal: AbortSignal.timeout(timeout_ms),
      });
    } catch (error) {
      throw new NoAnswer(String(error));
    }
    const content = await answer.json().catch(() => null);
    if (!answer.ok) throw new Refused(answer.status, content);
    return content;
  }

  // Start a job or a command. Its number identifies a repeated request: nothing is done twice when
  // an answer was lost.
  async command(path, body) {
    if (this.pending) return 0;
    this.pending = true;
    const end_s = now_s() + TRY_S;
    const wanted = { ...body, lease: this.lease, job: (this.state?.job?.number ?? 0) + 1 };
    try {
      for (;;) {
        try {
          return (await this.call("POST", path, { body: wanted })).job;
        } catch (error) {
          if (error instanceof Refused || now_s() > end_s) throw error;
          await wait(200);
        }
      }
    } finally {
      this.pending = false;
    }
  }

  start(goal) {
    return this.command("api/jobs", { goal });
  }

  // Needs no token and no lease; repeated until there is an answer.
  async hold() {
    const end_s = now_s() + TRY_S;
    for (;;) {
      try {
        return await this.call("POST", `api/hold?name=${this.name}`, { timeout_ms: 700 });
      } catch (error) {
        if (error instanceof Refused || now_s() > end_s) throw error;
        await wait(100);
      }
    }
  }

  // -- the lease ----------------------------------------------------------------------------------

  async acquire(take = false) {
    const { lease } = await this.call("POST", "api/lease", { body: { name: this.name, take } });
    this.lease = lease;
    this.aliveDue_s = now_s() + this.leaseTimeout_s / 4;
  }

  async giveUp() {
    const lease = this.lease;
    this.lease = 0;
    await this.call("DELETE", `api/lease/${lease}`);
  }

  async keepLease() {
    const now = now_s();
    if (!this.lease || now < this.aliveDue_s) return;
    this.aliveDue_s = now + this.leaseTimeout_s / 4;
    const lease = this.lease;
    try {
      await this.call("POST", `api/lease/${lease}/alive`);
    } catch (error) {
      if (error instanceof Refused && this.lease === lease) {
        this.lease = 0;
        this.on.lost();
      }
    }
  }
}

// The token is in the fragment of the address, which browsers do not send to servers.
function keptToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return sessionStorage.getItem("token") ?? "";
}
