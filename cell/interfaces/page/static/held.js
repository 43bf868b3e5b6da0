// The held part: name, probability, shape and size to scale, and the second answer.

import { byId, drawing, renew, setText, show } from "./dom.js";
import { doing, labelWord, notNamed, runs } from "./band.js";
import { clockShort, has, millimetres, number, percent, t } from "./words.js";

const FINGER_MM = 4;
const NAMING = ["identify", "sort"];

// The shown answer: {label, probability, ..., tentative}, or null before the first answer.
export function current(state) {
  const answers = state.shift?.answers ?? [];
  const newest = answers.at(-1) ?? null;
  const { job, status } = state;
  if (runs(job) && NAMING.includes(job.task)) {
    const fromThisJob = newest && newest.time_s >= (job.since_s ?? Infinity);
    const best = job.progress?.best;
    if (best) return { label: best, probability: job.progress.probability, tentative: true };
    if (job.task === "sort" && fromThisJob) return newest;
    return { tentative: true };
  }
  return status.holding ? answers.find((answer) => answer.number === state.held_part) ?? null : newest;
}

export const shapeWord = (kind, size_mm) =>
  (has(`shape.${kind}`) ? t(`shape.${kind}`, { size: millimetres(size_mm) }) : "");

// A part between two fingers, drawn to scale: closing axis vertical, with a ruler of 10 mm.
export function drawShape(svg, kind, size_mm, interval_mm = null) {
  renew(svg, [kind, size_mm, interval_mm], () => (kind && size_mm ? shapeParts(kind, size_mm, interval_mm) : []));
  svg.setAttribute("aria-label", shapeWord(kind, size_mm));
  show(svg.parentElement, Boolean(kind && size_mm));
}

export function shapeParts(kind, size_mm, interval_mm) {
  const k = Math.min(7, 96 / size_mm);
  const h = k * size_mm;
  const [cx, cy] = [100, 66];
  const at = (name, more) => drawing(name, { class: "part", ...more });
  const parts = [];
  for (const side of [-1, 1]) {
    const y = side < 0 ? cy - h / 2 - FINGER_MM * 2 : cy + h / 2;
    parts.push(drawing("rect", { class: "finger", x: 34, width: 132, y, height: FINGER_MM * 2, rx: 1.5 }));
  }
  if (interval_mm) {
    for (const edge of interval_mm) {
      for (const side of [-1, 1]) {
        const y = cy + (side * k * edge) / 2;
        parts.push(drawing("path", { class: "limit", d: `M${cx - h / 2 - 24} ${y}h${h + 48}` }));
      }
    }
  }
  if (kind === "sphere") parts.push(at("circle", { cx, cy, r: h / 2 }));
  else if (kind === "oval") parts.push(at("ellipse", { cx, cy, rx: 0.7 * h, ry: h / 2 }));
  else if (kind === "cylinder") {
    const long = Math.min(92, 2.2 * h);
    const d = `M${cx - long / 2} ${cy - h / 2}h${long}a${h / 6} ${h / 2} 0 0 1 0 ${h}h${-long}a${h / 6} ${h / 2} 0 0 1 0 ${-h}z`;
    parts.push(at("path", { d }));
    parts.push(drawing("ellipse", { class: "edge", cx: cx + long / 2, cy, rx: h / 6, ry: h / 2 }));
  } else if (kind === "flat") parts.push(at("rect", { x: cx - 46, width: 92, y: cy - h / 2, height: h }));
  else if (kind === "dumbbell") {
    parts.push(at("path", { d: `M${cx - 30} ${cy - h / 5}h60v${0.4 * h}h-60z` }));
    for (const side of [-1, 1]) parts.push(at("circle", { cx: cx + side * 34, cy, r: h / 2 }));
  } else parts.push(drawing("rect", { class: "part open", x: cx - h / 2, width: h, y: cy - h / 2, height: h, rx: h / 4 }));
  parts.push(drawing("path", { class: "size", d: `M182 ${cy - h / 2}v${h}M177 ${cy - h / 2}h10M177 ${cy + h / 2}h10` }));
  parts.push(drawing("path", { class: "size", d: `M34 143v4h${10 * k}v-4` }));
  const ruler = drawing("text", { class: "ruler", x: 40 + 10 * k, y: 148 });
  ruler.textContent = millimetres(10, 0);
  parts.push(ruler);
  return parts;
}

export function renderHeld({ state, info, taught, link }) {
  if (!state) return;
  const { status, job } = state;
  const answer = current(state);
  const panel = byId("held");
  const unknown = answer?.label === "UNKNOWN";
  const sure = answer?.probability >= (info?.sure_probability ?? 0.9);
  panel.classList.toggle("tentative", Boolean(answer?.tentative));
  panel.classList.toggle("unknown", unknown);
  panel.classList.toggle("unsure", Boolean(answer?.label) && !sure && !unknown && !answer.tentative);
  const when = answer?.time_s ? clockShort(answer.time_s) : "";
  const where = answer?.tentative ? doing(state)[0]
    : answer?.place ? t("held.at_place", { place: answer.place }) : status.holding ? t("held.in_grip")
      : answer ? t("held.let_go") : t("held.empty");
  const what = when && !answer.tentative ? `${where} – ${when}` : where;
  setText(byId("held_when"), link.stale ? t("held.last_known", { what }) : what);
  setText(byId("held_name"), !answer ? (status.holding ? t("held.not_named") : t("held.nothing"))
    : answer.label ? labelWord(answer.label) : t("held.feeling"));
  const size_mm = answer?.size_mm || null;
  const feels = answer?.shape && size_mm ? shapeWord(answer.shape, size_mm) : "";
  setText(byId("held_sure"), !answer?.label ? ""
    : notNamed(answer) ? t("held.not_named")
    : unknown ? (feels ? t("held.feels", { shape: feels }) : t("held.no_shape"))
      : answer.tentative ? t("held.so_far", { probability: percent(answer.probability) })
        : t(sure ? "held.sure" : "held.unsure", { probability: percent(answer.probability) }));
  byId("held_bar").style.width = `${100 * (answer?.label ? answer.probability ?? 0 : 0)}%`;
  const second = answer?.runner_up;
  setText(byId("held_second"), second ? t("held.second", {
    label: labelWord(second.label), probability: percent(second.probability),
  }) : "");

  const object = answer?.label ? taught.find(({ label }) => label === answer.label) : null;
  // The named object with the measured size. A line reports another shape whose size differs too: kinds are often similar.
  const clear = (shape) => shape !== "unclear" && has(`shape.${shape}`);
  const kind = clear(object?.shape) ? object.shape : answer?.shape;
  const drawn = kind && size_mm ? shapeWord(kind, size_mm) : "";
  drawShape(byId("held_shape"), answer?.tentative ? null : kind, size_mm, answer?.interval_mm);
  const size = drawn && answer.interval_mm
    ? t("held.size", { shape: drawn, low: number(answer.interval_mm[0], 1), high: millimetres(answer.interval_mm[1]) }) : drawn;
  const [low_mm, high_mm] = answer?.interval_mm ?? [-Infinity, Infinity];
  const disagree = feels && clear(answer.shape) && answer.shape !== kind && (object.size_mm < low_mm || object.size_mm > high_mm);
  setText(byId("held_size"), disagree ? `${size}\n${t("held.disagree", { shape: feels })}` : size);

  if (object) drawShape(byId("held_taught"), object.shape, object.size_mm);
  else show(byId("held_taught_box"), false);

  const checked = !runs(job) && job?.verification;
  const check = !checked ? "" : !checked.held ? "check.nothing" : checked.same === false ? "check.other" : "check.same";
  const unreached = job?.task !== "teach" && job?.progress?.unreached ? t("held.unreached", { force: number(job.progress.force_n, 1) }) : "";
  setText(byId("held_check"), check && (job.task === "verify" || !checked.held) ? t(check) : unreached);
  byId("held_check").classList.toggle("bad", check === "check.nothing" || check === "check.other");
}
