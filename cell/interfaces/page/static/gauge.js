// Gauge: drift of the sensors since teaching, before and after the grasp of a known object.

import { runs } from "./band.js";
import { allow, byId, drawing, isAllowed, make, renew, setText, show } from "./dom.js";
import { millimetres, number, t } from "./words.js";

// Ends of both scales; the marker of a larger value stays at the end.
const GAIN_PERCENT = 50;
const OPENING_MM = 5;
const LEFT = 20;
const WIDE = 260;

const gainText = (gain) => `${number(100 * (gain - 1), 0)}\u00a0%`;

// One scale: a ring for the value before, a disc for the value now.
function scale(y, word, end, unit, before, now) {
  const at = (value) => LEFT + WIDE * (0.5 + 0.5 * Math.max(-1, Math.min(1, value / end)));
  const text = (x, dy, anchor, what) => {
    const node = drawing("text", { x, y: y + dy, "text-anchor": anchor });
    node.textContent = what;
    return node;
  };
  const parts = [
    text(LEFT, -14, "start", word),
    drawing("line", { x1: LEFT, x2: LEFT + WIDE, y1: y, y2: y, class: "axis" }),
    drawing("line", { x1: at(0), x2: at(0), y1: y - 8, y2: y + 8, class: "axis" }),
    text(LEFT, 22, "start", `−${end}\u00a0${unit}`),
    text(at(0), 22, "middle", t("gauge.taught")),
    text(LEFT + WIDE, 22, "end", `+${end}\u00a0${unit}`),
  ];
  if (before != null) parts.push(drawing("circle", { cx: at(before), cy: y, r: 7, class: "before" }));
  if (now != null) parts.push(drawing("circle", { cx: at(now), cy: y, r: 5, class: "now" }));
  return parts;
}

export function setupGauge(view) {
  byId("gauge_form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!isAllowed(byId("gauge_start"))) return;
    view.start({ task: "gauge", label: byId("gauge_label").value });
  });
  byId("gauge_forget").addEventListener("click", () => isAllowed(byId("gauge_forget")) && view.send("forget_drift"));
}

export function renderGauge(view) {
  const { state, taught } = view;
  const drift = state?.health?.drift;
  show(byId("gauge"), Boolean(drift) && taught.length > 0);
  if (!drift) return;
  const { job } = state;
  const gauging = job?.task === "gauge";
  const gauged = gauging ? job.progress.gauged ?? null : null;
  if (gauging && runs(job)) byId("gauge").open = true;
  setText(byId("gauge_now"), t("gauge.now", { gain: gainText(drift.gain ?? 1), opening: millimetres(drift.opening_mm) }));
  renew(byId("gauge_label"), taught.map((object) => object.label), () => taught.map((object) => make("option", { value: object.label }, object.label)));
  const reason = view.why("gauge");
  allow(byId("gauge_start"), t("do.gauge"), t("hint.gauge"), reason);
  byId("gauge_forget").setAttribute("aria-disabled", String(Boolean(reason)));
  const before = gauged?.before;
  renew(byId("gauge_picture"), [drift.gain, drift.opening_mm, before], () => [
    ...scale(34, t("gauge.gain"), GAIN_PERCENT, "%", before && 100 * (before.gain - 1), 100 * ((drift.gain ?? 1) - 1)),
    ...scale(98, t("gauge.opening"), OPENING_MM, "mm", before?.opening_mm, drift.opening_mm),
  ]);
  setText(byId("gauge_end"), gauged ? t("gauge.done", {
    label: gauged.label,
    before: `${gainText(before.gain)}, ${millimetres(before.opening_mm)}`,
    after: `${gainText(gauged.after.gain)}, ${millimetres(gauged.after.opening_mm)}`,
  }) : gauging && !runs(job) ? t("gauge.not_done") : "");
}
