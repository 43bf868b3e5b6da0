// The shift: the last twenty answers, each opens its grasp, and the totals of the shift.

import { byId, make, renew, setText } from "./dom.js";
import { labelWord, notNamed, taskWord } from "./band.js";
import { shapeWord } from "./held.js";
import { drawChart, drawPads } from "./measured.js";
import { clock, clockShort, language, newtons, number, percent, t } from "./words.js";

const KEPT = 20;
let opened = null;
let days = null;
let asked = "";

const kindOf = (answer, sure) =>
  (answer.label === "UNKNOWN" ? "unknown" : answer.probability >= sure ? "sure" : "unsure");

// The sums of the days are requested with each part, turn and fault, and each minute.
function askDays({ link, changed }, shift) {
  const due = [shift.parts, shift.missed, shift.faults, Math.floor(Date.now() / 60000)].join();
  if (due === asked) return;
  asked = due;
  link.call("GET", "api/history", { timeout_ms: 5000 }).then((sums) => {
    days = sums;
    changed();
  }).catch(() => setTimeout(() => (asked = ""), 2000));
}

function daySpans() {
  const name = new Intl.RelativeTimeFormat(language, { numeric: "auto" });
  const spans = [["today", 0, "day"], ["yesterday", -1, "day"], ["week", 0, "week"]].map(([key, n, unit]) => {
    const lost = ["rejected", "missed", "faults"].filter((kind) => days[key]?.[kind])
      .map((kind) => `${t(`shift.${kind}`)} ${number(days[key][kind])}`).join(", ");
    return make("span", { class: "count" }, `${name.format(n, unit)} `, make("b", {}, number(days[key]?.parts)), lost && ` (${lost})`);
  });
  const pairs = (days.week?.confused ?? []).map(({ held, named, n, confirmed }) =>
    `${labelWord(held)} ${confirmed ? "→" : "≈"} ${labelWord(named)} ${n}×`).join(", ");
  return pairs ? [...spans, make("span", {}, t("shift.confused", { pairs }))] : spans;
}

export function renderShift(view) {
  const { state, info, open } = view;
  const { shift } = state ?? {};
  const { locale } = Intl.DateTimeFormat().resolvedOptions();
  renew(byId("figures"), shift ? [shift.parts, shift.parts_last_hour, shift.cycle_s, shift.rejected, shift.missed, shift.faults] : null, () => {
    if (!shift) return [];
    const figure = (key, value, watch = false) => make("div", watch ? { class: "watch" } : {},
      make("dt", {}, t(`shift.${key}`)), make("dd", {}, value));
    return [
      figure("parts", number(shift.parts ?? 0)),
      figure("last_hour", number(shift.parts_last_hour ?? 0)),
      figure("cycle", shift.cycle_s == null ? "–" : `${number(shift.cycle_s, 1)} s`),
      figure("rejected", number(shift.rejected ?? 0)),
      figure("missed", number(shift.missed ?? 0)),
      figure("faults", number(shift.faults ?? 0), shift.faults > 0),
    ];
  });
  if (shift) askDays(view, shift);
  renew(byId("days"), days, () => (days ? daySpans() : []));
  const answers = (shift?.answers ?? []).slice(-KEPT);
  const sure = info?.sure_probability ?? 0.9;
  renew(byId("strip"), [locale, sure, answers], () => [
    ...Array.from({ length: KEPT - answers.length }, () => make("li", { class: "none", "aria-hidden": "true" })),
    ...answers.map((answer) => {
      const kind = kindOf(answer, sure);
      const name = labelWord(answer.label);
      const button = make("button", { type: "button", class: kind, title: name },
        make("i", { "aria-hidden": "true" }), make("b", {}, kind === "unknown" ? "?" : name), make("span", {}, clockShort(answer.time_s)));
      button.setAttribute("aria-label", [name, percent(answer.probability), t(notNamed(answer) ? "held.not_named" : `kind.${kind}`),
        clock(answer.time_s), answer.place ?? ""].filter(Boolean).join(", "));
      button.addEventListener("click", () => open(answer));
      return make("li", {}, button);
    }),
  ]);
  const counts = Object.entries(shift?.counts ?? {}).sort((a, b) => b[1] - a[1]);
  renew(byId("counts"), [counts, shift?.since_s, !state], () => [
    ...counts.map(([label, n]) => make("span", { class: label === "UNKNOWN" ? "count unknown" : "count" },
      labelWord(label), " ", make("b", {}, number(n)))),
    make("span", { class: "muted" }, !state ? "" : !shift ? t("shift.none") : !counts.length ? t("shift.empty")
      : shift.since_s ? t("shift.since", { clock: clockShort(shift.since_s) }) : ""),
  ]);
}

// The grasp of an answer: its pads at the highest force and its ramp.
export async function openGrasp({ link, info }, answer) {
  const dialog = byId("grasp");
  setText(byId("grasp_title"), `${labelWord(answer.label)} – ${percent(answer.probability)}`);
  const facts = [taskWord(answer.task), clock(answer.time_s), t("shift.grasps", { n: answer.n_grasps ?? 0 }),
    answer.seconds ? `${number(answer.seconds, 1)} s` : "", answer.shape ? shapeWord(answer.shape, answer.size_mm) : "",
    answer.runner_up ? t("shift.second", { label: labelWord(answer.runner_up.label), probability: percent(answer.runner_up.probability) }) : "",
    answer.place ?? ""].filter(Boolean).join(" · ");
  setText(byId("grasp_text"), facts);
  opened = null;
  drawOpened();
  if (!dialog.open) dialog.show();
  try {
    const grasp = await link.call("GET", `api/grasps/${encodeURIComponent(answer.number)}`, { timeout_ms: 5000 });
    opened = { info, grasp };
  } catch {
    setText(byId("grasp_text"), `${facts} · ${t("shift.grasp_gone")}`);
  }
  drawOpened();
}

export function drawOpened() {
  const grasp = opened?.grasp;
  for (const name of ["grasp_pads", "grasp_chart"]) byId(name).hidden = !grasp;
  if (!grasp) return;
  const series = grasp.t_s.map((t_s, i) => ({
    t_s, force_n: grasp.force_n[i], setpoint_n: grasp.setpoint_n[i], opening_mm: grasp.opening_mm[i],
  }));
  const frame = grasp.frame ? Float32Array.from(grasp.frame) : null;
  const highest = Math.max(0, ...grasp.force_n);
  byId("grasp_pads").setAttribute("aria-label", t("measured.pads_say", { force: newtons(highest) }));
  byId("grasp_chart").setAttribute("aria-label", t("shift.chart_say", { force: newtons(highest) }));
  byId("grasp_pads").hidden = !frame;
  if (frame) {
    drawPads(byId("grasp_pads"), opened.info?.pads, frame, {
      full_n: Math.max(0.1, ...frame.map((force_n) => Math.ceil(10 * force_n) / 10)), note: "",
    });
  }
  drawChart(byId("grasp_chart"), series, {
    begin_s: series[0]?.t_s ?? 0, end_s: series.at(-1)?.t_s ?? 1, levels_n: [], live: false,
  });
}
