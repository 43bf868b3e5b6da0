// The page: it shows the state of the cell; this file joins the parts.

import { ask, byId, setText, show } from "./dom.js";
import { NoAnswer } from "./link.js";
import { millimetres, number, t } from "./words.js";
import { renderBand, runs } from "./band.js";
import { renderHeld } from "./held.js";
import { forget, renderMeasured, takeFrame, takeValues } from "./measured.js";
import { drawOpened, openGrasp, renderShift } from "./shift.js";
import { renderHealth } from "./health.js";
import { renderFault } from "./fault.js";
import { beginPage, reasonOf, renderCommands, setupCommands } from "./commands.js";
import { renderTeach, setupTeach } from "./teach.js";
import { renderGauge, setupGauge } from "./gauge.js";
import { renderSort, setupSort } from "./sort.js";
import { renderSimulation, setupSimulation } from "./simulation.js";
import { renderShare, setupShare } from "./share.js";

const TABS = ["held", "teach", "sort"];
const TAB_OF = { identify: "held", grip: "held", verify: "held", teach: "teach", gauge: "teach", zero: "teach", sort: "sort" };
let dirty = true;
let lastJob = null;

const view = {
  link: null, info: null, state: null, taught: [],
  changed: () => (dirty = true),
  why: (command, any) => reasonOf(view, command, any),
  say(text, bad = false) {
    const place = byId("said");
    setText(place, text);
    place.classList.toggle("bad", bad);
  },
  open: (answer) => openGrasp(view, answer),
  tab: chooseTab,
  ask,
  refreshTaught,
};

function chooseTab(name) {
  for (const tab of TABS) {
    const chosen = tab === name;
    byId(`tab_${tab}`).setAttribute("aria-selected", String(chosen));
    byId(`tab_${tab}`).tabIndex = chosen ? 0 : -1;
    show(byId(tab), chosen);
  }
  dirty = true;
}

async function refreshInfo() {
  try {
    view.info = await view.link.call("GET", "api/info", { timeout_ms: 5000 });
    view.link.leaseTimeout_s = view.info.lease_timeout_s ?? 2;
    await view.askAccess();
    await refreshTaught();
  } catch {
    setTimeout(refreshInfo, 1000);
  }
}

async function refreshTaught() {
  try {
    view.taught = await view.link.call("GET", "api/taught", { timeout_ms: 5000 });
  } catch (error) {
    if (error instanceof NoAnswer) setTimeout(refreshTaught, 1000);
    else view.taught = (view.info?.labels ?? []).map((label) => ({ label }));
  }
  dirty = true;
}

function take(state) {
  const before = view.state;
  view.state = state;
  takeValues(state, Date.now() / 1000);
  const job = state.job ?? {};
  if (before && before.taught_revision !== state.taught_revision) refreshTaught();
  if (runs(job) && !(runs(lastJob) && lastJob.number === job.number)) {
    if (TAB_OF[job.task]) chooseTab(TAB_OF[job.task]);
    view.say("");
  }
  lastJob = { number: job.number, outcome: job.outcome };
  dirty = true;
}

function renderPose() {
  const { state, link } = view;
  const pose = state?.pose;
  show(byId("pose"), Boolean(pose) && link.commands);
  if (!pose) return;
  const degrees = (rad) => `${number((180 / Math.PI) * (rad ?? 0), 0)}°`;
  setText(byId("pose_text"), t("pose.text", {
    x: millimetres(1000 * (pose.x_m ?? 0)), y: millimetres(1000 * (pose.y_m ?? 0)),
    rotation: degrees(pose.rotation_rad), roll: degrees(pose.roll_rad),
  }));
}

let wasStale = null;
function render() {
  requestAnimationFrame(render);
  const { stale } = view.link;
  if (!dirty && stale === wasStale) return;
  wasStale = stale;
  dirty = false;
  if (stale) forget();
  for (const part of [renderBand, renderFault, renderHeld, renderMeasured, renderShift, renderHealth,
    renderCommands, renderTeach, renderGauge, renderSort, renderPose, renderSimulation, renderShare]) part(view);
}

function setup() {
  setupCommands(view);
  setupTeach(view);
  setupGauge(view);
  setupSort(view);
  setupSimulation(view);
  setupShare(view);
  byId("tabs").addEventListener("click", (event) => {
    const name = event.target.id?.replace("tab_", "");
    if (TABS.includes(name)) chooseTab(name);
  });
  byId("tabs").addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const at = TABS.findIndex((tab) => byId(`tab_${tab}`) === document.activeElement);
    if (!step || at < 0) return;
    const name = TABS[(at + step + TABS.length) % TABS.length];
    chooseTab(name);
    byId(`tab_${name}`).focus();
  });
  for (const [id, ok] of [["pose_ok", true], ["pose_no", false]]) {
    byId(id).addEventListener("click", () => view.attempt(() => view.link.call("POST", "api/pose", {
      body: { lease: view.link.lease, seq: view.state.pose_seq, ok },
    })));
  }
  byId("grasp_close").addEventListener("click", () => byId("grasp").close());
  window.addEventListener("resize", () => {
    dirty = true;
    drawOpened();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    dirty = true;
    drawOpened();
  });
}

beginPage(view, { setup, render, state: take, frame: takeFrame, connected: refreshInfo });
