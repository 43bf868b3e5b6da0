// The drawer of a simulated cell: part between the fingers and its pose, faults, reset.

import { allow, byId, isAllowed, make, renew, setText, show } from "./dom.js";
import { runs } from "./band.js";
import { faultMeaning, number, t } from "./words.js";

// Lengths in mm: name, minimum, maximum, initial value.
const SHAPES = {
  "cylinder": [["diameter", 2, 16, 8], ["length", 5, 40, 20]],
  "sphere": [["diameter", 3, 16, 10]],
  "box": [["length", 5, 40, 16], ["width", 2, 16, 10], ["height", 2, 16, 10]],
  "ellipsoid": [["length", 5, 40, 14], ["diameter", 3, 16, 11]],
  "dumbbell": [["length", 8, 40, 14], ["diameter", 4, 16, 10]],
};
const POSE = { "x_m": "mm", "y_m": "mm", "rotation_rad": "°", "roll_rad": "°" };
const SI = { mm: 1e-3, "°": Math.PI / 180 };
const IN_TURN = "";
const OWN = " shape";
let now = null; // the part in the cell
let faults = null;
let asking = false;
let chosenPart = null; // the part that the cell has when the drawer opens first

function slider(name, unit, min, max, value) {
  const range = make("input", { type: "range", min, max, step: unit === "mm" ? 0.5 : 5, value, name });
  const output = make("output", {});
  const tell = () => setText(output, `${number(range.valueAsNumber)} ${unit}`);
  range.addEventListener("input", tell);
  tell();
  return make("label", {}, make("span", {}, t(`sim.${name}`), " ", output), range);
}

const options = (pairs) => pairs.map(([value, word]) => make("option", { value }, word));

// The faults in words, one group for each device.
function faultGroups(kinds) {
  const groups = new Map();
  for (const kind of kinds) {
    const [device] = kind.name.split(".");
    if (!groups.has(device)) groups.set(device, make("optgroup", { label: device }));
    groups.get(device).append(make("option", { value: kind.name }, faultMeaning(kind)));
  }
  return [...groups.values()];
}

const values = (id) => [...byId(id).querySelectorAll("input")].map((input) => [input.name, input.valueAsNumber]);

function chosen() {
  const part = byId("sim_part").value;
  if (part === IN_TURN) return null;
  if (part !== OWN) return part;
  return `${byId("sim_kind").value}:${values("sim_lengths").map(([name, mm]) => `${name}=${mm}mm`).join(",")}`;
}

// Set the controls to a part and its pose.
function take({ part, pose }) {
  const set = (input, value) => {
    input.value = value;
    input.dispatchEvent(new Event("input"));
  };
  for (const input of byId("sim_pose").querySelectorAll("input")) set(input, pose[input.name] / SI[POSE[input.name]]);
  const [kind, lengths] = (part ?? "").split(":");
  chosenPart = lengths && SHAPES[kind] ? OWN : part;
  if (chosenPart !== OWN) return;
  byId("sim_kind").value = kind;
  renewLengths();
  for (const [name, mm] of lengths.split(",").map((text) => text.split("="))) {
    const input = byId("sim_lengths").querySelector(`[name=${name}]`);
    if (input) set(input, parseFloat(mm));
  }
}

function renewLengths() {
  show(byId("sim_shape"), byId("sim_part").value === OWN);
  const kind = byId("sim_kind").value;
  renew(byId("sim_lengths"), kind, () =>
    SHAPES[kind].map(([name, ...range]) => slider(name, "mm", ...range)));
}

// Return the text of a shape such as cylinder:diameter=8mm,length=20mm.
function partWord(part) {
  if (part === null || part === "nothing") return t(part ? "sim.nothing" : "sim.in_turn");
  const [kind, lengths] = part.split(":");
  if (!SHAPES[kind] || !lengths) return part;
  return `${t(`sim.${kind}`)} ${lengths.split(",").map((text) => text.split("=")[1].replace("mm", "")).join(" × ")}\u00a0mm`;
}

export function setupSimulation(view) {
  const { link, attempt } = view;
  const send = (method, path, body) => link.call(method, `api/simulation/${path}`, { body, timeout_ms: 6000 });
  const refresh = async () => {
    if (asking || link.stale) return;
    asking = true;
    try {
      const first = !now;
      [now, faults] = [await send("GET", "part"), await send("GET", "faults")];
      if (first) take(now);
    } catch { /* the next look asks again */ } finally {
      asking = false;
    }
    view.changed();
  };
  const act = (id, what) => byId(id).addEventListener("click", () => isAllowed(byId(id)) && attempt(what).then(refresh));

  byId("sim_kind").append(...options(Object.keys(SHAPES).map((kind) => [kind, t(`sim.${kind}`)])));
  byId("sim_pose").append(...Object.entries(POSE).map(([name, unit]) => slider(name, unit, ...(unit === "mm" ? [-6, 6] : [-90, 90]), 0)));
  for (const id of ["sim_part", "sim_kind"]) byId(id).addEventListener("change", renewLengths);
  byId("simulated").addEventListener("click", () => {
    if (byId("simulation").open) byId("simulation").close();
    else byId("simulation").show();
    refresh();
  });
  byId("simulation_close").addEventListener("click", () => byId("simulation").close());
  setInterval(() => byId("simulation").open && refresh(), 1000);

  act("sim_put", () => send("POST", "part", {
    lease: link.lease,
    part: chosen(),
    pose: Object.fromEntries(values("sim_pose").map(([name, value]) => [name, value * SI[POSE[name]]])),
  }));
  const written = () => byId("sim_value").value.trim().replace(/^(-?\d+),(\d+)$/, "$1.$2");
  act("sim_begin", () => send("POST", "faults", {
    fault: byId("sim_fault").value + (written() ? `=${written()}` : ""),
  }));
  byId("sim_fault").addEventListener("change", () => { byId("sim_value").value = ""; view.changed(); });
  act("sim_reset", () => send("POST", "reset", { lease: link.lease }));
  view.endFault = (fault) => attempt(() => send("DELETE", `faults?fault=${encodeURIComponent(fault)}`)).then(refresh);
}

export function renderSimulation(view) {
  const { state, link, info } = view;
  show(byId("simulated"), Boolean(info?.simulated));
  if (!byId("simulation").open || !state || !now || !faults) return;
  const reason = view.why("simulation");
  const watches = link.viewOnly || link.stale ? reason : "";
  const held = reason || (state.status.holding ? t("sim.held") : "");
  setText(byId("sim_placed"), partWord(now.placed ?? "nothing"));
  setText(byId("sim_taken"), partWord(now.part));
  const part = chosenPart ?? byId("sim_part").value;
  chosenPart = null;
  renew(byId("sim_part"), now.objects, () => options([
    [IN_TURN, t("sim.in_turn")], ["nothing", t("sim.nothing")], [OWN, t("sim.own")], ...now.objects.map((name) => [name, name])]));
  if (part && byId("sim_part").value !== part) byId("sim_part").value = part;
  renewLengths();
  allow(byId("sim_put"), t("sim.put"), t("sim.put_hint"), held);
  allow(byId("sim_reset"), t("sim.reset"), t("sim.reset_hint"), reason || (runs(state.job) ? t("why.state.EXECUTE") : ""));

  renew(byId("sim_fault"), faults.kinds.map(({ name }) => name), () => faultGroups(faults.kinds));
  const kind = faults.kinds.find(({ name }) => name === byId("sim_fault").value);
  const value = kind?.value;
  show(byId("sim_value").parentNode, Boolean(value));
  setText(byId("sim_unit"), value?.unit ?? "");
  byId("sim_value").placeholder = value?.default ?? "";
  setText(byId("sim_meaning"), kind?.name ?? "");
  allow(byId("sim_begin"), t("sim.begin"), t("sim.begin_hint"), watches);
  renew(byId("sim_running"), [faults.running, watches], () => faults.running.map(({ fault, begun }) => {
    const end = make("button", { type: "button", class: "plain" }, t("sim.end"));
    end.setAttribute("aria-label", t("sim.end_of", { fault }));
    end.addEventListener("click", () => isAllowed(end) && view.endFault(fault));
    end.setAttribute("aria-disabled", String(Boolean(watches)));
    return make("li", {}, make("span", {}, begun ? fault : `${fault} ...`), end);
  }));
}
