// Teach: name, photograph, grasps; result of each grasp, separation, taught objects.

import { allow, byId, drawing, isAllowed, make, renew, setText, show } from "./dom.js";
import { runs } from "./band.js";
import { shapeParts, shapeWord } from "./held.js";
import { faultText, millimetres, newtons, number, percent, t } from "./words.js";

const PHOTO_PX = 640;
const PHOTO_MAX = 500_000;
const TOLD_APART = 0.02; // share of grasps that may be confused
let photo = null;
let waiting = null; // photograph of the object that is being taught
let stream = null;

// A picture as JPEG, small enough to store with the model.
async function shrink(source, width, height) {
  const scale = Math.min(1, PHOTO_PX / Math.max(width, height));
  const canvas = make("canvas");
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  canvas.getContext("2d").drawImage(source, 0, 0, canvas.width, canvas.height);
  for (const quality of [0.85, 0.6, 0.3]) {
    const blob = await new Promise((go) => canvas.toBlob(go, "image/jpeg", quality));
    if (blob && blob.size <= PHOTO_MAX) return blob;
  }
  throw new Error("the photograph is too large");
}

function setPhoto(blob) {
  const image = byId("teach_photo");
  if (photo) URL.revokeObjectURL(image.src);
  photo = blob;
  show(image, Boolean(blob));
  show(byId("teach_photo_away"), Boolean(blob));
  if (blob) image.src = URL.createObjectURL(blob);
}

function stopCamera() {
  stream?.getTracks().forEach((track) => track.stop());
  stream = null;
}

export function setupTeach(view) {
  const { link, say } = view;
  byId("teach_form").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!isAllowed(byId("teach_start"))) return;
    const label = byId("teach_name").value.trim();
    waiting = photo ? { label, photo } : null;
    view.start({ task: "teach", label, grasps: byId("teach_grasps").valueAsNumber });
  });
  byId("teach_file").addEventListener("change", async (event) => {
    const [file] = event.target.files;
    event.target.value = "";
    if (!file) return;
    try {
      const image = await createImageBitmap(file);
      setPhoto(await shrink(image, image.width, image.height));
    } catch {
      say(t("teach.no_picture"), true);
    }
  });
  byId("teach_photo_away").addEventListener("click", () => setPhoto(null));
  byId("teach_camera").addEventListener("click", async () => {
    try {
      stream = await navigator.mediaDevices.getUserMedia({ video: { facingMode: "environment" } });
    } catch {
      say(t("teach.no_camera"), true);
      return;
    }
    byId("camera_video").srcObject = stream;
    byId("camera").show();
  });
  byId("camera_take").addEventListener("click", async () => {
    const video = byId("camera_video");
    const blob = await shrink(video, video.videoWidth || 1, video.videoHeight || 1);
    byId("camera").close();
    setPhoto(blob);
  });
  byId("camera_close").addEventListener("click", () => byId("camera").close());
  byId("camera").addEventListener("close", stopCamera);
}

// The photograph is sent when its object is taught: before that, the cell has no such object.
export async function teachEnded(view, job) {
  if (waiting && job.outcome === "SUCCEEDED") {
    const { label, photo: body } = waiting;
    setPhoto(null);
    await view.attempt(() => view.link.fetch("PUT",
      `api/taught/${encodeURIComponent(label)}/photo?lease=${view.link.lease}`, { body, type: body.type, timeout_ms: 10_000 }));
  }
  waiting = null;
  view.refreshTaught();
}

function result(taught) {
  const { mistaken_share: share } = taught;
  if (share == null) return t("teach.done");
  if (!taught.nearest || share <= TOLD_APART) return t("teach.well");
  return t("teach.near", { label: taught.nearest, share: percent(share) });
}

export function renderTeach(view) {
  const { state, taught, photo: photoOf } = view;
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
    renew(byId("teach_each"), each, () => each.map((one, i) => make("li", { value: i + 1 },
      ...[number(i + 1), newtons(one.force_n), millimetres(one.opening_mm), one.size_mm ? `⌀ ${millimetres(one.size_mm)}` : ""]
        .map((text) => make("span", {}, text)))).reverse());
    setText(byId("teach_end"), runs(job) ? "" : job.progress.taught ? result(job.progress.taught)
      : job.outcome === "SUCCEEDED" ? t("teach.done") : t(`teach.${job.outcome}`, { reason: faultText({ number: job.fault_number, text: job.error }) }));
  }
  renew(byId("teach_names"), taught.map((one) => one.label), () => taught.map((one) => make("option", { value: one.label })));
  const off = Boolean(reason);
  renew(byId("taught"), [taught, off, taught.map((one) => (one.photo ? photoOf(one) : null))], () =>
    (taught.length ? taught.map((one) => {
      const url = one.photo ? photoOf(one) : null;
      const image = url ? make("img", { alt: "", src: url }) : drawing("svg", { "aria-hidden": "true", class: "kind shape", viewBox: "30 0 140 132" });
      if (!url && one.shape && one.size_mm) image.append(...shapeParts(one.shape, one.size_mm, null).slice(0, -3));
      const back = make("button", { type: "button", class: "plain" }, t("teach.back"));
      const forget = make("button", { type: "button", class: "plain" }, t("teach.forget"));
      back.setAttribute("aria-label", t("teach.back_of", { label: one.label }));
      forget.setAttribute("aria-label", t("teach.forget_of", { label: one.label }));
      for (const button of [back, forget]) button.setAttribute("aria-disabled", String(off));
      const path = `api/taught/${encodeURIComponent(one.label)}`;
      const away = (at, last = "") => view.attempt(() => view.link.call("DELETE", `${at}?lease=${view.link.lease}${last}`, { timeout_ms: 20_000 })).then(view.refreshTaught);
      back.addEventListener("click", () => isAllowed(back) && view.ask(t("teach.back_sure", { label: one.label }), t("teach.back"), () => away(path, "&last=true")));
      forget.addEventListener("click", () => isAllowed(forget) && view.ask(t("teach.forget_sure", { label: one.label, n: one.n_grasps ?? 0 }), t("teach.forget"), () => away(path)));
      const facts = [one.n_grasps == null ? "" : t("shift.grasps", { n: one.n_grasps }), one.shape && one.size_mm ? shapeWord(one.shape, one.size_mm) : ""];
      return make("li", {}, image, make("span", {}, make("b", {}, one.label), make("small", {}, facts.filter(Boolean).join(" · "))), back, forget);
    }) : [make("li", { class: "muted" }, t("teach.none"))]));
}
