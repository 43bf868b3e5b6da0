// The commissioning wizard: its steps, questions, planned writes and results.

import { allow, ask, byId, isAllowed, make, renew, setText, show } from "./dom.js";
import { renderCommander, setSign } from "./band.js";
import { beginPage, setupLease } from "./commands.js";
import { loadSentences, spoken } from "./sentences.js";
import { clock, language, native, number, t } from "./words.js";

const LOOKS = {
  ready: ["calm", "ready"],
  working: ["calm", "working"],
  asking: ["watch", "part"],
  approving: ["watch", "hold"],
  left: ["calm", "stopped"],
  failed: ["bad", "fault"],
  finished: ["calm", "ready"],
};
const OPEN = ["ready", "left", "failed", "finished"]; // no step runs
const pictures = new Map(); // URL of each fetched figure, by its address
let dirty = true;
let shownId = 0;

const view = {
  link: null, info: null, state: null,
  changed: () => (dirty = true),
  say(text, bad = false) {
    setText(byId("said"), text);
    byId("said").classList.toggle("bad", bad);
  },
  heldText: () => t("wizard.stopped"),
};

// A sentence of the wizard in the language of the page, else in English, and that language.
const told = (text) => {
  const step = view.state?.steps.find((one) => text.startsWith(`${one.title} failed`));
  const own = spoken(step ? text.replace(step.title, native(step.title)) : text);
  return { lang: own === text ? "en" : language, text: own };
};
const tell = (node, text) => {
  const { lang, text: own } = told(text);
  setText(node, own);
  node.lang = lang;
};
const line = (kind, text, marks = {}) => {
  const { lang, text: own } = told(text);
  return make(kind, { lang, ...marks }, own);
};

const why = () => (view.link.stale ? t("why.connection") : view.link.commands ? "" : t("why.lease"));
const idle = () => OPEN.includes(view.state?.phase);

function post(path, body = {}) {
  return view.attempt(() => view.link.call("POST", path, { body: { lease: view.link.lease, ...body }, timeout_ms: 5000 }));
}

const answer = (value) => post("api/answer", { asked_id: view.state.asked_id, value });

function renderBand() {
  const { link, info, state } = view;
  document.body.classList.toggle("stale", link.stale);
  document.body.classList.toggle("starting", !state && Number.isFinite(link.age_s));
  const phase = state?.phase ?? "ready";
  const word = link.stale ? t("state.away") : t(`wizard.${phase}`);
  const [level, sign] = link.stale ? ["bad", "away"] : LOOKS[phase];
  setText(byId("cell"), info?.name ?? "");
  byId("cell").title = info?.folder ?? "";
  setText(byId("state"), word);
  const done = state?.steps.filter((step) => ["pass", "warn"].includes(step.status)).length ?? 0;
  setText(byId("since"), state ? t("wizard.done", { done, of: state.steps.length }) : "");
  const step = state?.steps.find((one) => one.key === state.step);
  setText(byId("doing"), step ? native(step.title) : "");
  document.title = `${word} – ${info?.name ?? "tactile-cell"}`;
  setSign(level, sign);
  renderCommander(view);
}

function picture(step, name) {
  const path = `api/steps/${encodeURIComponent(step.key)}/figures/${encodeURIComponent(name)}`;
  const key = `${path} ${step.ended}`;
  const image = make("img", { alt: step.figures[name] });
  if (!pictures.has(key)) {
    pictures.set(key, view.link.fetch("GET", path, { timeout_ms: 20000 })
      .then((found) => found.blob()).then((blob) => URL.createObjectURL(blob)));
  }
  pictures.get(key).then((url) => (image.src = url)).catch(() => pictures.delete(key));
  return make("figure", {}, image, make("figcaption", { lang: "en" }, step.figures[name]));
}

function renderSteps() {
  const { state } = view;
  if (!state) return;
  const list = byId("steps");
  while (list.children.length < state.steps.length) {
    const details = make("details", {}, make("summary"), make("div"));
    details.addEventListener("toggle", view.changed);
    list.append(make("li", {}, details));
  }
  state.steps.forEach((step, at) => {
    const item = list.children[at];
    const [summary, body] = item.firstElementChild.children;
    const status = step.status || "open";
    item.dataset.status = status;
    if (step.key === state.step) item.setAttribute("aria-current", "step");
    else item.removeAttribute("aria-current");
    renew(summary, [step.title, status], () => [
      make("b", {}, `${at + 1}. ${native(step.title)}`), make("span", {}, t(`wizard.status.${status}`)),
    ]);
    if (!item.firstElementChild.open) return;
    const may = status !== "open" && idle() && !why();
    renew(body, [step, may], () => [
      make("p", { class: "muted" }, native(step.purpose)),
      ...step.lines.map((text) => line("p", text)),
      ...Object.keys(step.figures).map((name) => picture(step, name)),
      make("p", { class: "muted" }, step.ended ? `${clock(Date.parse(step.ended) / 1000)} – ` : "", line("span", step.undo)),
      ...(may ? [redoButton(step)] : []),
    ]);
  });
}

function redoButton(step) {
  const button = make("button", { type: "button", class: "plain" }, t("wizard.redo"));
  button.addEventListener("click", () => ask(t("wizard.redo_sure", { title: native(step.title) }), t("wizard.redo"),
    () => post("api/redo", { key: step.key })));
  return button;
}

function renderNow() {
  const { state, info } = view;
  if (!state) return;
  const step = state.steps.find((one) => one.key === state.step);
  setText(byId("now_title"), step ? native(step.title) : t("wizard.title", { name: info?.name ?? "" }));
  setText(byId("now_purpose"), step ? native(step.purpose) : state.phase === "finished" ? "" : t("wizard.what"));
  const error = state.error;
  tell(byId("now_error"), error ? [error.text, error.number ? error.remedy : ""].filter(Boolean).join(" – ") : "");
  // Between two runs: the steps that need attention.
  const noted = state.steps.filter((one) => ["warn", "fail"].includes(one.status));
  const failed = step && state.question?.key === `${step.key}.again`;
  const said = step ? (failed ? step.lines : state.said).map((text) => ["", text])
    : noted.flatMap((one) => one.lines.map((text) => [`${native(one.title)}: `, text]));
  renew(byId("now_said"), said, () => said.map(([title, text]) => make("li", {}, title, line("span", text))));
  const live = Object.entries(state.live);
  renew(byId("now_live"), live, () => live.flatMap(([name, value]) => [line("dt", name), line("dd", value)]));
  show(byId("corrected"), state.phase === "finished" && state.corrected.length > 0);
  renew(byId("corrected_lines"), state.corrected, () => state.corrected.map((text) => line("li", text)));
  setText(byId("files"), state.files.length ? t("wizard.files", { files: state.files.join(", ") }) : "");
  byId("main").dataset.asked = state.asked_id;
  renderQuestion();
  renderApproval();
}

function renderQuestion() {
  const { state } = view;
  const question = state.phase === "asking" ? state.question : null;
  show(byId("question"), Boolean(question));
  if (!question) return;
  tell(byId("question_text"), question.text);
  const reason = why();
  const choices = question.choices ?? [];
  renew(byId("question_choices"), [state.asked_id, choices, reason], () => choices.map((choice) => {
    const button = make("button", { type: "button", ...(choice.key === question.default ? { class: "first" } : {}) });
    allow(button, told(choice.text).text, "", reason);
    if (choice.picture) button.prepend(make("img", { src: `page/${choice.picture}.svg`, alt: "" }));
    button.addEventListener("click", () => isAllowed(button) && answer(choice.key));
    return button;
  }));
  show(byId("question_field"), !choices.length);
  allow(byId("question_send"), t("wizard.send"), "", reason);
  const range = question.number;
  setText(byId("question_unit"), range?.unit ?? "");
  setText(byId("question_range"), range
    ? t("wizard.range", { low: number(range.lowest), high: number(range.highest), unit: range.unit }) : "");
  if (shownId === state.asked_id) return;
  shownId = state.asked_id;
  const field = byId("question_value");
  field.type = range ? "number" : "text";
  if (range) Object.assign(field, { min: range.lowest, max: range.highest, step: "any" });
  field.value = question.default ?? "";
  field.required = Boolean(range);
  if (!reason) (choices.length ? byId("question_choices").firstElementChild : field).focus({ preventScroll: true });
  byId("question").scrollIntoView({ block: "nearest" });
}

function renderApproval() {
  const { state } = view;
  const wanted = state.phase === "approving";
  show(byId("approval"), wanted);
  if (!wanted) return;
  renew(byId("writes"), [state.asked_id, state.writes], () => state.writes.map((write) => make("li", {},
    line("b", write.where), line("span", write.what),
    make("span", { class: "change" }, told(write.before).text, make("i", {}, " → "), told(write.after).text),
    make("small", {}, t("wizard.undo", { text: told(write.undo).text })))));
  allow(byId("approve"), t("wizard.approve"), t("wizard.approve_hint"), why());
  allow(byId("refuse"), t("wizard.refuse"), t("wizard.refuse_hint"), why());
  if (shownId === state.asked_id) return;
  shownId = state.asked_id;
  byId("approval").scrollIntoView({ block: "nearest" });
}

function renderCommands() {
  const { state } = view;
  const phase = state?.phase ?? "ready";
  const begun = state?.steps.some((step) => step.status);
  show(byId("run"), idle());
  const [word, hint] = phase === "finished" ? ["wizard.again", "wizard.again_hint"]
    : [begun ? "wizard.go_on" : "wizard.begin", "wizard.run_hint"];
  allow(byId("run"), t(word), t(hint), why());
  show(byId("leave"), !idle());
  allow(byId("leave"), t("wizard.leave"), t("wizard.leave_hint"), why());
  show(byId("record"), Boolean(begun) && idle());
  allow(byId("record"), t("wizard.record"), t("wizard.record_hint"), view.link.stale ? t("why.connection") : "");
}

// The record is one file, which is saved unchanged.
async function saveRecord() {
  const found = await view.link.fetch("GET", "api/record", { timeout_ms: 30000 });
  const url = URL.createObjectURL(await found.blob());
  make("a", { href: url, download: "commissioning.html" }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

async function refreshInfo() {
  try {
    view.info = await view.link.call("GET", "api/info", { timeout_ms: 5000 });
    view.link.leaseTimeout_s = view.info.lease_timeout_s;
  } catch {
    setTimeout(refreshInfo, 1000);
  }
  dirty = true;
}

function render() {
  requestAnimationFrame(render);
  if (!dirty) return;
  dirty = false;
  for (const part of [renderBand, renderSteps, renderNow, renderCommands]) part();
}

function setup() {
  setupLease(view, ["sure"]);
  const click = (id, act) => byId(id).addEventListener("click", () => isAllowed(byId(id)) && act());
  click("run", () => post("api/run"));
  click("leave", () => post("api/leave"));
  click("record", () => view.attempt(saveRecord));
  click("approve", () => answer(true));
  click("refuse", () => answer(false));
  byId("question").addEventListener("submit", (event) => {
    event.preventDefault();
    const field = byId("question_value");
    if (isAllowed(byId("question_send"))) answer(field.type === "number" ? field.valueAsNumber : field.value);
  });
}

await loadSentences();
beginPage(view, {
  setup,
  render,
  lost: "wizard.lost",
  state(state) {
    view.state = state;
    dirty = true;
  },
  frame: () => {},
  connected: refreshInfo,
});
