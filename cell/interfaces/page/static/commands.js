// Commands: Hold for everybody, the others for the page in command. A blocked button shows why.

import { allow, ask, byId, isAllowed, onLongPress, setText } from "./dom.js";
import { Link, Refused } from "./link.js";
import { runs } from "./band.js";
import { faultText, has, loadWords, native, t } from "./words.js";

const RELEASE_KEY = 0x4f50;
const DIALOGS = ["grasp", "sure", "simulation", "share"]; // Escape closes them

// Reason why a command is not allowed now; empty if it is. `any`: for any client in command.
export function reasonOf({ link, state, taught }, command, any = false) {
  if (!state || link.stale) return t("why.connection");
  if (!any && !link.commands) return t(link.viewOnly ? "why.view_only" : "why.lease");
  if (!any && link.pending) return t("why.sent");
  if (command === "simulation") return ""; // the simulator itself refuses impossible requests
  const { status, allowed, held_by: heldBy = [] } = state;
  const refusal = allowed[command];
  if (!refusal) return command in allowed ? "" : t("why.not_offered");
  if (refusal.number === 515) return t("why.held_by", { names: heldBy.join(", ") });
  if (runs(state.job)) return t("why.state.EXECUTE");
  const onHold = command === "verify" && status.state === "HELD"; // then a part may be in the grip
  if (has(`why.only.${command}`) && !onHold && !WITH_FAULT.includes(status.state)) return t(`why.only.${command}`);
  if (refusal.number === 505 && status.state !== "IDLE") return ofState(status.state);
  if (command === "sort" && refusal.number === 501) return t("why.no_place");
  return taught.length || refusal.number !== 505 ? faultText(refusal) : t("why.not_taught");
}

const WITH_FAULT = ["ABORTING", "ABORTED", "CLEARING", "RESETTING"];
const ofState = (state) => (has(`why.state.${state}`) ? t(`why.state.${state}`) : state);

// The error of a request, as text.
export function complaint(error) {
  if (!(error instanceof Refused)) return t("said.no_answer");
  const text = error.number === 505 || error.number === 513 || !error.number
    ? error.message : faultText({ number: error.number, text: error.message });
  const remedy = error.number ? native(error.remedy) : "";
  return t("said.refused", { text: remedy ? `${text} – ${remedy}` : text });
}

// Start the page: words, its `setup` and `render`, then the connection; asks for the token.
// `on` has the callbacks of a Link.
export async function beginPage(view, { setup, render, ...on }) {
  const login = (wrong) => {
    setText(byId("login_wrong"), wrong ? t("login.wrong") : "");
    if (!byId("login").open) byId("login").show();
  };
  view.link = new Link({ ...on, refused: () => login(true), lost: () => view.say(t("said.lost"), true) });
  await loadWords();
  byId("sure_no").addEventListener("click", () => byId("sure").close());
  byId("login_form").addEventListener("submit", () => view.link.login(byId("login_token").value.trim()));
  setup();
  // Old values are marked as not live, also when no message comes.
  setInterval(view.changed, 250);
  render();
  if (view.link.token) view.link.connect();
  else login(false);
}

export function setupCommands(view) {
  const { link, say } = view;
  const attempt = async (act, done = "") => {
    try {
      await act();
      say(done);
    } catch (error) {
      say(complaint(error), true);
    }
    view.changed();
  };
  view.attempt = attempt;
  const hold = byId("hold");
  hold.disabled = false;
  const doHold = () => {
    hold.classList.add("sent");
    attempt(() => link.hold(), t("said.held")).finally(() => setTimeout(() => hold.classList.remove("sent"), 600));
  };
  hold.addEventListener("click", doHold);
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || event.repeat) return;
    doHold();
    for (const name of DIALOGS) byId(name).close();
  });

  byId("command").addEventListener("click", () => {
    const name = view.state?.commander;
    if (link.commands) attempt(() => link.giveUp());
    else if (!name) attempt(() => link.acquire());
    else ask(t("who.take_sure", { name }), t("who.take_over"), () => attempt(() => link.acquire(true)));
  });

  view.start = (goal) => attempt(() => link.start(goal));
  view.send = (command, more = {}) => attempt(() => link.command("api/commands", {
    command, ...(command === "release" ? { key: RELEASE_KEY } : {}), ...more,
  }));

  const click = (id, act) => byId(id).addEventListener("click", () => isAllowed(byId(id)) && act());
  click("do_identify", () => view.start({ task: "identify", keep: byId("keep").value }));
  click("do_grip", () => byId("force").reportValidity() && view.start({ task: "grip", force_n: byId("force").valueAsNumber || 0 }));
  click("do_verify", () => view.start({ task: "verify" }));
  click("do_sort", () => {
    view.tab("sort");
    byId("sort_parts").focus();
  });
  click("do_zero", () => view.start({ task: "zero" }));
  click("do_clear", () => view.send("clear"));
  click("do_reset", () => view.send("reset"));
  onLongPress(byId("do_release"), 1, () => view.send("release"));
}

export function renderCommands(view) {
  for (const command of ["identify", "grip", "verify", "sort", "zero", "clear", "reset"]) {
    allow(byId(`do_${command}`), t(`do.${command}`), t(`hint.${command}`), reasonOf(view, command));
    byId(`do_${command}`).title = view.state?.allowed?.[command]?.text ?? "";
  }
  allow(byId("do_release"), t("do.release"), t("release.hint"), reasonOf(view, "release"));
  if (view.info) byId("force").max = view.info.force_cap_n;
  setText(byId("hold").firstElementChild, t("hold.word"));
}
