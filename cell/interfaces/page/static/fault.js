// The card of a fault: cause, state of the grip, steps. It replaces cards that are not needed.

import { allow, byId, make, onLongPress, renew, setText, show } from "./dom.js";
import { faultText, has, native, t } from "./words.js";

const AFTER = ["ABORTING", "ABORTED", "CLEARING", "RESETTING"];
const COMMANDS = { clear: "clear", clear_reboot: "clear", release: "release", reset: "reset" };
let last = null;

// The fault that is shown; it stays after `clear` until the cell is ready again.
export function dealtWith(state) {
  if (!state || !AFTER.includes(state.status.state)) {
    last = state?.fault ?? null;
    return last;
  }
  const { status } = state;
  if (state.fault) last = state.fault;
  else if (status.fault) last = { number: status.fault_number, text: status.fault, detail: status.fault };
  return last ?? { number: 0, text: t("fault.cleared") };
}

function stepsOf(fault, status) {
  return fault.steps ? [...fault.steps] : (status.holding ? ["support_part", "clear", "release", "reset"] : ["look", "mend", "clear", "reset"]);
}

export function renderFault(view) {
  const { state, why, send } = view;
  const fault = dealtWith(state);
  if (fault && !document.body.classList.contains("faulted")) scrollTo(0, 0);
  document.body.classList.toggle("faulted", Boolean(fault));
  show(byId("fault"), Boolean(fault));
  if (!fault) return;
  setText(byId("fault_number"), fault.number ? t("fault.number", { number: String(fault.number) }) : "");
  setText(byId("fault_title"), faultText(fault));
  setText(byId("fault_cause"), native(fault.cause));
  setText(byId("fault_grip"), native(fault.grip) || (state.status.holding ? t("fault.may_hold") : t("fault.holds_nothing")));
  setText(byId("fault_detail"), native(fault.detail ?? fault.text));
  const recording = fault.recording ?? state.health?.recording?.path ?? "";
  setText(byId("fault_recording"), recording ? t("fault.keep", { path: recording }) : t("fault.no_recording"));

  const steps = stepsOf(fault, state.status);
  for (const command of ["clear", "release", "reset"]) {
    // Other commands that the state allows stay possible.
    if (!steps.some((step) => COMMANDS[step] === command) && !why(command, true)) steps.push(command);
  }
  const commands = steps.filter((step) => COMMANDS[step]);
  // With empty fingers a release stays allowed, but is no longer a step.
  const needed = (step) => step !== "release" || state.status.holding;
  const next = commands.find((step) => needed(step) && !why(COMMANDS[step], true));
  const done = new Set(next ? steps.slice(0, steps.indexOf(next)).filter((step) => COMMANDS[step]) : []);
  const list = byId("fault_steps");
  const remedy = native(fault.remedy);
  renew(list, [steps, remedy, document.documentElement.lang], () => steps.map((step) => {
    const text = step === "mend" && remedy ? remedy : has(`step.${step}`) ? t(`step.${step}`) : step;
    const item = make("li", { "data-step": step }, make("p", {}, text));
    if (COMMANDS[step]) {
      const button = make("button", { type: "button", class: step === "release" ? "release" : "" });
      if (step === "release") onLongPress(button, 1, () => send("release"));
      else button.addEventListener("click", () => button.getAttribute("aria-disabled") !== "true" && send(COMMANDS[step], { reboot: step === "clear_reboot" }));
      item.append(button);
    }
    return item;
  }));
  for (const item of list.children) {
    const { step } = item.dataset;
    item.classList.toggle("next", step === next);
    item.classList.toggle("done", done.has(step));
    const button = item.querySelector("button");
    if (!button) continue;
    const hint = step === "release" ? t("release.hint") : step === next ? t("fault.next") : " ";
    const reason = why(COMMANDS[step]);
    allow(button, t(`do.${step}`), hint, reason && done.has(step) ? t("fault.done") : reason);
  }
}
