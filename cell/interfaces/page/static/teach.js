// Teach: name, grasps; result of each grasp, separation, taught objects.

import { allow, byId, drawing, isAllowed, make, renew, setText, show } from "./dom.js";
import { runs } from "./band.js";
import { shapeParts, shapeWord } from "./held.js";
import { faultText, millimetres, newtons, number, percent, t } from "./words.js";

const TOLD_APART = 0.02; // share of grasps that may be confused

export function setupTeach(view) {
  byId("teach_form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!isAllowed(byId("teach_start"))) return;
    view.start({ task: "teach", label: byId("teach_name").value.trim(), grasps: byId("teach_grasps").valueAsNumber });
  });
}

function result(taught) {
  return taught.zero_note ? `${apart(taught)} ${t("teach.zero")}` : apart(taught);
}

function apart(taught) {
  const { mistaken_share: share, left_out = [] } = taught;
  if (left_out.length) return t("teach.left_out", { labels: left_out.join(", ") });
  if (share == null) return t("teach.done");
  if (!taught.nearest || share <= TOLD_APART) return t("teach.well");
  return t("teach.near", { label: taught.nearest, share: percent(share) });
}

export function renderTeach(view) {
  const { state, taught } = view;
  if (!state) return;
  const reason = view.why("teach");
  allow(byId("teach_start"), t("do.teach"), t("hint.teach"), reason);
  const { job } = state;
  const teaching = job?.task === "teach";
  const { label = "", grasps = 0, of = 0, missed = 0, each = [] } = (teaching && job.progress) || {};
  show(byId("teach_now"), teaching);
  show(byId("teach_form"), !(teaching && runs(job)));
  if (teaching) {
    setText(byId("teach_progress"), t("teach.progress", { label, grasps, of }) + (missed ? ` – ${t("teach.missed", { n: missed })}` : ""));
    byId("teach_bar").style.width = `${of ? (100 * grasps) / of : 0}%`;
    renew(byId("teach_each"), each, () => each.map((grasp, i) => make("li", { value: i + 1 },
      ...[number(i + 1), newtons(grasp.force_n), millimetres(grasp.opening_mm), grasp.size_mm ? `⌀ ${millimetres(grasp.size_mm)}` : ""]
        .map((text) => make("span", {}, text)))).reverse());
    setText(byId("teach_end"), runs(job) ? "" : job.progress.taught ? result(job.progress.taught)
      : job.outcome === "SUCCEEDED" ? t("teach.done") : t(`teach.${job.outcome}`, { reason: faultText({ number: job.fault_number, text: job.error }) }));
  }
  renew(byId("teach_names"), taught.map((object) => object.label), () => taught.map((object) => make("option", { value: object.label })));
  const off = Boolean(reason);
  renew(byId("taught"), [taught, off], () =>
    (taught.length ? taught.map((object) => {
      const image = drawing("svg", { "aria-hidden": "true", class: "kind shape", viewBox: "30 0 140 132" });
      if (object.shape && object.size_mm) image.append(...shapeParts(object.shape, object.size_mm, null).slice(0, -3));
      const back = make("button", { type: "button", class: "plain" }, t("teach.back"));
      const forget = make("button", { type: "button", class: "plain" }, t("teach.forget"));
      back.setAttribute("aria-label", t("teach.back_of", { label: object.label }));
      forget.setAttribute("aria-label", t("teach.forget_of", { label: object.label }));
      for (const button of [back, forget]) button.setAttribute("aria-disabled", String(off));
      const path = `api/taught/${encodeURIComponent(object.label)}`;
      const away = (at, last = "") => view.attempt(() => view.link.call("DELETE", `${at}?lease=${view.link.lease}${last}`, { timeout_ms: 20_000 })).then(view.refreshTaught);
      back.addEventListener("click", () => isAllowed(back) && view.ask(t("teach.back_sure", { label: object.label }), t("teach.back"), () => away(path, "&last=true")));
      forget.addEventListener("click", () => isAllowed(forget) && view.ask(t("teach.forget_sure", { label: object.label, n: object.n_grasps ?? 0 }), t("teach.forget"), () => away(path)));
      const facts = [object.n_grasps == null ? "" : t("shift.grasps", { n: object.n_grasps }), object.shape && object.size_mm ? shapeWord(object.shape, object.size_mm) : ""];
      return make("li", {}, image, make("span", {}, make("b", {}, object.label), make("small", {}, facts.filter(Boolean).join(" · "))), back, forget);
    }) : [make("li", { class: "muted" }, t("teach.none"))]));
}
