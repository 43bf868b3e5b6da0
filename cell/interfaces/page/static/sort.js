// Sort: places with their counts, the rejects, and the present part.

import { allow, byId, isAllowed, make, renew, setText } from "./dom.js";
import { labelWord, runs } from "./band.js";
import { number, t } from "./words.js";

export function setupSort(view) {
  byId("sort_form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (isAllowed(byId("sort_start"))) view.start({ task: "sort", parts: byId("sort_parts").valueAsNumber });
  });
}

export function renderSort(view) {
  const { state, info } = view;
  if (!state) return;
  allow(byId("sort_start"), t("do.sort"), t("hint.sort_start"), view.why("sort"));
  const { job } = state;
  const progress = (job?.task === "sort" && job.progress) || {};
  const parts = Array.isArray(progress.parts) ? progress.parts.length : progress.parts ?? 0;
  setText(byId("sort_progress"), progress.of ? t("sort.progress", { parts, of: progress.of }) : "");
  const running = job?.task === "sort" && runs(job);
  const latest = running ? job.part : null;
  setText(byId("sort_way"), !running ? "" : latest ? t("sort.brought", { label: labelWord(latest.label), place: latest.place }) : t("sort.first"));
  const counts = progress.places ?? Object.fromEntries((info?.places ?? []).map((name) => [name, 0]));
  const names = Object.keys(counts);
  const most = Math.max(1, ...Object.values(counts));
  renew(byId("sort_places"), [counts, latest?.place], () => (names.length ? names.map((name, i) => {
    const reject = i === names.length - 1 && names.length > 1;
    const bar = make("i");
    bar.style.width = `${(100 * counts[name]) / most}%`;
    return make("li", { class: [reject ? "reject" : "", name === latest?.place ? "latest" : ""].join(" ") },
      make("span", {}, name, reject ? make("small", {}, t("sort.reject")) : ""),
      make("div", { class: "bar" }, bar), make("b", {}, number(counts[name])));
  }) : [make("li", { class: "muted" }, t("sort.none"))]));
}
