// Health in words: one short line if all is well, else the problems first.

import { byId, make, renew } from "./dom.js";
import { dealtWith } from "./fault.js";
import { number, t } from "./words.js";

const LEVELS = ["bad", "watch", "ok"];
const most = (values) => (values?.length ? Math.max(...values.filter((value) => value !== null)) : null);

function sentences(health) {
  const { servos, can, loop, drift, zero, recording } = health;
  const facts = [];
  const add = (level, key, values) => facts.push([LEVELS.includes(level) ? level : "watch", t(key, values)]);
  if (servos && (servos.level !== "ok" || servos.temperature_c?.length)) {
    add(servos.level, servos.load?.length ? "health.servos" : "health.servos_heat", {
      heat: number(most(servos.temperature_c), 0), load: number(100 * (most(servos.load) ?? 0), 0),
    });
  }
  if (can) add(can.level, can.level === "ok" ? "health.can_well" : "health.can", { lost: can.lost ?? 0, frames: number(can.frames ?? 0), age: number(can.age_s == null ? null : 1000 * can.age_s, 0) });
  if (loop) add(loop.level, loop.level === "ok" ? "health.loop_well" : "health.loop", { late: loop.late ?? 0, p99: number(loop.p99_ms, 1) });
  if (drift) add(drift.level, "health.drift", { gain: number(100 * ((drift.gain ?? 1) - 1), 1), opening: number(drift.opening_mm, 2) });
  if (zero?.text) add(zero.level, "health.zero", {});
  if (recording) add(recording.level, recording.path ? "health.recording" : "health.no_recording", {});
  if (recording?.text && recording.level !== "ok") facts.at(-1)[1] += `: ${recording.text}`;
  return facts.sort((a, b) => LEVELS.indexOf(a[0]) - LEVELS.indexOf(b[0]));
}

export function renderHealth({ state, link }) {
  const node = byId("health");
  const facts = state?.health && !link.stale ? sentences(state.health) : [];
  const well = !dealtWith(state) && facts.length > 0 && facts.every(([level]) => level === "ok");
  renew(node, [link.stale, well, facts, document.documentElement.lang], () => {
    node.setAttribute("aria-label", t("health.title"));
    if (!facts.length) return [make("span", { class: "muted" }, t(link.stale ? "health.not_now" : "health.none"))];
    const lines = facts.map(([level, text]) => make("span", { class: `line ${level}` },
      level === "ok" ? "" : `${t(`level.${level}`)} – `, text));
    return well ? [make("b", {}, `✓ ${t("health.well")}`), ...lines] : lines;
  });
}
