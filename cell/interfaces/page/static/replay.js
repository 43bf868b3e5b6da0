// Replay: a recording instead of the cell, with pause, speed and a slider over its grasps.

import { byId, setText, show } from "./dom.js";
import { number, t } from "./words.js";

export function setupReplay(view) {
  const { link } = view;
  const ask = (body) => view.attempt(() => link.call("POST", "api/replay", { body }));
  byId("replay_pause").addEventListener("click", () => ask({ pause: !view.state?.replay?.paused }));
  byId("replay_speed").addEventListener("change", (event) => ask({ speed: Number(event.target.value) }));
  byId("replay_grasp").addEventListener("change", (event) => ask({ grasp: event.target.valueAsNumber }));
  const open = async (file) => {
    if (!file) return;
    setText(byId("replay_said"), t("replay.sending", { name: file.name }));
    await view.attempt(() => link.fetch("PUT", "api/replay", { body: file, type: "application/octet-stream", timeout_ms: 120_000 }));
    setText(byId("replay_said"), "");
    link.renew();
  };
  byId("replay_file").addEventListener("change", (event) => open(event.target.files[0]));
  const replaying = () => view.info?.mode === "replay";
  document.addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.toggle("drop", replaying());
  });
  document.addEventListener("dragleave", () => document.body.classList.remove("drop"));
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("drop");
    if (replaying()) open(event.dataTransfer.files[0]);
  });
}

export function renderReplay({ state, info }) {
  const replay = state?.replay;
  const on = info?.mode === "replay" || Boolean(replay);
  document.body.classList.toggle("replaying", on);
  show(byId("replay"), on);
  if (!replay) return;
  setText(byId("replay_title"), replay.name ? t("replay.name", { name: replay.name }) : t("replay.title"));
  if (replay.lost_reason) setText(byId("replay_said"), replay.lost_reason);
  setText(byId("replay_pause"), t(replay.paused ? "replay.go" : "replay.pause"));
  const slider = byId("replay_grasp");
  slider.max = String(replay.of || 1);
  if (document.activeElement !== slider) slider.value = String(replay.grasp || 1);
  const speed = byId("replay_speed");
  if (document.activeElement !== speed && [...speed.options].some((one) => Number(one.value) === replay.speed)) {
    speed.value = [...speed.options].find((one) => Number(one.value) === replay.speed).value;
  }
  setText(byId("replay_at"), t("replay.at", { grasp: replay.grasp ?? 0, of: replay.of ?? 0, t: number(replay.t_s, 1) }));
}
