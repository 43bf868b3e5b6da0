// The band across the top: state, running job, client in command, and whether the values are live.

import { byId, setText } from "./dom.js";
import { clock, duration, faultText, has, percent, t } from "./words.js";

// Shapes in a square of 24: each state has its own symbol, which is clear without colour.
const SIGNS = {
  stopped: "M5 5h14v14H5zM8 8v8h8V8z",
  ready: "M12 3a9 9 0 1 0 .01 0zM12 6.2a5.8 5.8 0 1 1-.01 0z",
  working: "M6 3.5v17L20.5 12z",
  part: "M3 3h18v5H3zM3 16h18v5H3zM12 9.2a2.8 2.8 0 1 0 .01 0z",
  hold: "M5 3.5h5v17H5zM14 3.5h5v17h-5z",
  fault: "M12 2 23 21.5H1zM10.8 9v6.2h2.4V9zM10.8 17v2.4h2.4V17z",
  reset: "M12 4V1L7 5.5 12 10V7a5 5 0 1 1-5 5H4a8 8 0 1 0 8-8z",
  away: "M4.9 2.8 2.8 4.9 9.9 12l-7.1 7.1 2.1 2.1 7.1-7.1 7.1 7.1 2.1-2.1-7.1-7.1 7.1-7.1-2.1-2.1-7.1 7.1z",
};
const LOOKS = {
  STOPPED: ["off", "stopped"],
  STARTING: ["calm", "working"],
  IDLE: ["calm", "ready"],
  EXECUTE: ["calm", "working"],
  COMPLETE: ["calm", "part"],
  HOLDING: ["watch", "hold"],
  HELD: ["watch", "hold"],
  STOPPING: ["off", "stopped"],
  ABORTING: ["bad", "fault"],
  ABORTED: ["bad", "fault"],
  CLEARING: ["watch", "reset"],
  RESETTING: ["watch", "reset"],
};

export const runs = (job) => job?.outcome === "EXECUTING" || job?.outcome === "ACCEPTED";

export function taskWord(task) {
  const key = [`task.${task}`, `do.${task}`].find(has);
  return key ? t(key) : task;
}

// Name of a label for people; UNKNOWN is an answer too.
export const labelWord = (label) => (label === "UNKNOWN" ? t("label.unknown") : label);

// Whether a part has no name because it looks like several taught objects.
export const notNamed = (answer) => answer.label === "UNKNOWN" && !(answer.unknown >= 0.5);

// The running job and its progress.
export function doing(state) {
  const { job, status } = state;
  if (!job?.number) return ["", ""];
  const progress = job.progress ?? {};
  if (!runs(job)) {
    const reason = job.fault_number && job.outcome === "ABORTED"
      ? faultText(state.fault?.number === job.fault_number ? state.fault : { number: job.fault_number, text: job.error }) : "";
    const named = job.outcome === "SUCCEEDED" && job.part ? `${labelWord(job.part.label)}, ${percent(job.part.probability)}` : "";
    return [t(`ended.${job.outcome}`, { task: taskWord(job.task) }), reason || named];
  }
  const first = job.task === "teach" && progress.label
    ? t("doing.teach", { label: progress.label }) : taskWord(job.task);
  if (job.task === "sort") {
    const of = progress.of ?? 0;
    return [`${first} – ${t("doing.part", { part: Math.min((progress.parts ?? 0) + 1, of), of })}`,
      t(`grip.${status.grasp}`)];
  }
  if (!progress.of) return [first, t(`grip.${status.grasp}`)];
  const grasp = t("doing.grasp", { grasp: Math.min((progress.grasps ?? 0) + 1, progress.of), of: progress.of });
  const likeliest = progress.best
    ? t("doing.best", { label: labelWord(progress.best), probability: percent(progress.probability) })
    : t(`grip.${status.grasp}`);
  return [`${first} – ${grasp}`, likeliest];
}

export function renderBand({ link, info, state }) {
  setText(byId("cell"), info?.name ?? "");
  document.body.classList.toggle("stale", link.stale);
  document.body.classList.toggle("starting", !state && Number.isFinite(link.age_s));
  let level = "bad";
  let sign = "away";
  if (link.stale && (!link.token || link.stopped)) {
    setText(byId("state"), t("state.away"));
    setText(byId("since"), "");
    setText(byId("doing"), t("band.no_token"));
    setText(byId("doing_more"), "");
  } else if (link.stale) {
    setText(byId("state"), t("state.away"));
    setText(byId("since"), state
      ? t("band.last_seen", { clock: clock(link.heard_s), ago: duration(link.age_s) }) : t("band.never_seen"));
    setText(byId("doing"), t(link.socket && link.lag_s > 1 ? "band.slow" : "band.trying"));
    setText(byId("doing_more"), t("band.not_now"));
  } else {
    const { status, held_by: heldBy = [] } = state;
    [level, sign] = LOOKS[status.state] ?? ["watch", "hold"];
    // The fingers are at rest, and the frames are being evaluated.
    const thinks = status.state === "IDLE" && runs(state.job);
    const word = thinks ? t("state.evaluating") : has(`state.${status.state}`) ? t(`state.${status.state}`) : status.state;
    if (thinks) [level, sign] = LOOKS.EXECUTE;
    setText(byId("state"), word);
    const since_s = runs(state.job) ? state.job.since_s ?? status.since_s : status.since_s;
    setText(byId("since"), since_s
      ? t("band.since", { clock: clock(since_s), ago: duration(state.time_s - since_s) }) : "");
    const [what, more] = doing(state);
    setText(byId("doing"), heldBy.length ? t("band.held_by", { names: heldBy.join(", ") }) : what);
    setText(byId("doing_more"), heldBy.length ? what : more);
    if (heldBy.length && level === "calm") [level, sign] = ["watch", "hold"];
    document.title = `${word} – ${info?.name ?? "tactile-cell"}`;
  }
  if (link.stale) document.title = `${t("state.away")} – ${info?.name ?? "tactile-cell"}`;
  setSign(level, sign);
  renderCommander({ link, state });
}

// Colour and symbol of the band.
function setSign(level, sign) {
  setText(byId("told"), byId("state").textContent); // screen readers announce changes only
  const band = byId("band");
  if (band.dataset.level !== level) band.dataset.level = level;
  if (byId("sign").getAttribute("d") !== SIGNS[sign]) byId("sign").setAttribute("d", SIGNS[sign]);
}

function renderCommander({ link, state }) {
  const commander = state?.commander ?? "";
  setText(byId("commander"), link.stale ? "" : link.commands ? t("who.you")
    : commander ? t("who.other", { name: commander }) : t("who.nobody"));
  const button = byId("command");
  setText(button, link.commands ? t("who.give_up") : commander ? t("who.take_over") : t("who.take"));
  button.disabled = link.stale;
}
