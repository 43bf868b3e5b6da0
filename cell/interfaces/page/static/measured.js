// Measured values: forces of all taxels in the pads' true geometry, and the last ten seconds.

import { byId, colour, setText, show, sized } from "./dom.js";
import { runs } from "./band.js";
import { has, millimetres, newtons, number, t } from "./words.js";

const WINDOW_S = 10;
const GAP_S = 0.5; // s: no line is drawn over a longer pause
const TOUCH_N = 0.03; // N: the largest reading of an untouched taxel
const TOUCH_SHARE = 0.15; // edge of the contact, as a share of the pad's highest taxel
const PAD_TOUCHED_N = 0.3;
const FONT = "system-ui, sans-serif";

let frame = null;
let scale_n = 0.2;
let peaks = [];
const history = [];

// A frame follows its state. Without a frame nothing is measured.
let framed = false;
export function takeFrame(values) {
  frame = values;
  framed = true;
}

export function takeValues(state, now_s) {
  const { live } = state;
  if (!framed) frame = null;
  framed = false;
  const t_s = state.time_s ?? now_s;
  if (history.length && t_s < history.at(-1).t_s) history.length = 0;
  if (history.at(-1)?.t_s === t_s) history.pop();
  history.push({ t_s, force_n: live.force_n, setpoint_n: live.setpoint_n, opening_mm: live.opening_mm });
  while (history.length && history[0].t_s < t_s - WINDOW_S - 1) history.shift();
}

export function forget() {
  frame = null;
  history.length = 0;
}

// -- pads -----------------------------------------------------------------------------------------

function shadeOf(share) {
  const stops = colour("shades").split(",");
  const at = Math.max(0, Math.min(1, share)) * (stops.length - 1);
  const low = Math.min(Math.floor(at), stops.length - 2);
  const [a, b] = [stops[low], stops[low + 1]].map((hex) => parseInt(hex.trim().slice(1), 16));
  const mix = (shift) => {
    const [x, y] = [(a >> shift) & 255, (b >> shift) & 255];
    return Math.round(x + (y - x) * (at - low));
  };
  return `rgb(${mix(16)} ${mix(8)} ${mix(0)})`;
}

// Positions of a pad's taxels in mm from its corner; x is along the finger.
function geometry(pad) {
  pad.geometry ??= (() => {
    const [dx, dy] = pad.pitch_mm ?? [4, 4];
    const places = pad.taxels ?? Array.from({ length: pad.rows * pad.columns }, (_, i) =>
      [Math.floor(i / pad.columns) * dx, (i % pad.columns) * dy]);
    const [x0, y0] = [0, 1].map((axis) => Math.min(...places.map((place) => place[axis])));
    const xy = places.map(([x, y]) => [x - x0, y - y0]);
    return {
      xy, dx, dy,
      width: Math.max(...xy.map(([x]) => x)) + dx,
      height: Math.max(...xy.map(([, y]) => y)) + dy,
    };
  })();
  return pad.geometry;
}

function drawPad(context, pad, values, { x, y, k, full_n, marks }) {
  const { xy, dx, dy, width, height } = geometry(pad);
  const gap = Math.max(0.5, 0.05 * k * Math.min(dx, dy));
  const forces = values.subarray(pad.first, pad.first + xy.length);
  const sum = forces.reduce((all, force) => all + force, 0);
  context.fillStyle = colour("line");
  context.fillRect(x, y, k * width, k * height);
  forces.forEach((force, i) => {
    context.fillStyle = shadeOf(Math.max(0, force / full_n) ** 0.75);
    context.fillRect(x + k * xy[i][0] + gap / 2, y + k * xy[i][1] + gap / 2, k * dx - gap, k * dy - gap);
  });
  if (!marks || sum < PAD_TOUCHED_N) return sum;
  const edge = Math.max(TOUCH_N, TOUCH_SHARE * Math.max(...forces));
  const inside = new Map(xy.map((place, i) => [place.map((v) => v.toFixed(2)).join(), forces[i] > edge]));
  const touched = (px, py) => inside.get([px, py].map((v) => v.toFixed(2)).join()) ?? false;
  context.strokeStyle = colour("ink");
  context.lineWidth = 2;
  context.beginPath();
  for (const [px, py] of xy.filter(([px, py]) => touched(px, py))) {
    const [left, top, right, bottom] = [x + k * px, y + k * py, x + k * (px + dx), y + k * (py + dy)];
    if (!touched(px - dx, py)) { context.moveTo(left, top); context.lineTo(left, bottom); }
    if (!touched(px + dx, py)) { context.moveTo(right, top); context.lineTo(right, bottom); }
    if (!touched(px, py - dy)) { context.moveTo(left, top); context.lineTo(right, top); }
    if (!touched(px, py + dy)) { context.moveTo(left, bottom); context.lineTo(right, bottom); }
  }
  context.stroke();
  const centre = [0, 1].map((axis) => forces.reduce((all, force, i) => all + force * xy[i][axis], 0) / sum);
  const [cx, cy] = [x + k * (centre[0] + dx / 2), y + k * (centre[1] + dy / 2)];
  for (const [stroke, width_px] of [["card", 5], ["ink", 2]]) {
    context.strokeStyle = colour(stroke);
    context.lineWidth = width_px;
    context.beginPath();
    context.arc(cx, cy, 5, 0, 2 * Math.PI);
    for (const [ux, uy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(cx + 5 * ux, cy + 5 * uy);
      context.lineTo(cx + 10 * ux, cy + 10 * uy);
    }
    context.stroke();
  }
  return sum;
}

// Steps of 1, 2, 5: small changes of the force do not change the scale.
function calmScale(peak_n) {
  const now_s = performance.now() / 1000;
  peaks.push([now_s, peak_n]);
  peaks = peaks.filter(([at_s]) => now_s - at_s < WINDOW_S);
  const highest = Math.max(...peaks.map(([, peak]) => peak));
  return [0.2, 0.5, 1, 2, 5, 10, 20, 50].find((step) => highest <= step) ?? 100;
}

export function drawPads(canvas, pads, values, { full_n, note = "" }) {
  const surface = sized(canvas);
  if (!surface || !pads?.length) return;
  const { context, width, height } = surface;
  const inner = pads.filter((pad) => pad.inner);
  const LABEL = 24;
  const LEGEND = note ? 44 : 22;
  const GAP = 18;
  const others = inner.map(({ finger }) => pads.filter((pad) => !pad.inner && pad.finger === finger));
  const most = (list, value) => Math.max(0, ...list.map(value));
  const wide = most(inner, (pad) => geometry(pad).width);
  const high = most(inner, (pad) => geometry(pad).height);
  const stack = most(others, (list) => list.reduce((all, pad) => all + geometry(pad).height, 0));
  const broad = most(others.flat(), (pad) => geometry(pad).width);
  const share = stack ? high / stack : 0; // scale of the small pads: they get the height of the inner pad
  const k = Math.min(
    (width - (stack ? GAP : 0)) / (wide + broad * share * 0.9),
    (height - LEGEND - inner.length * LABEL - 8) / (inner.length * high),
  );
  const small = 0.9 * k * share;
  const x0 = Math.max(0, (width - k * wide - (stack ? GAP + small * broad : 0)) / 2);
  context.textBaseline = "middle";
  let y = 0;
  inner.forEach((pad, i) => {
    const sum = drawPad(context, pad, values, { x: x0, y: y + LABEL, k, full_n, marks: true });
    context.fillStyle = colour("muted");
    context.font = `14px ${FONT}`;
    context.textAlign = "left";
    context.fillText(t("measured.finger", { finger: pad.finger }), x0, y + LABEL / 2);
    context.fillStyle = colour("ink");
    context.font = `600 16px ${FONT}`;
    context.textAlign = "right";
    context.fillText(newtons(sum), x0 + k * wide, y + LABEL / 2);
    const gap = others[i].length > 1 ? (0.1 * k * high) / (others[i].length - 1) : 0;
    let below = y + LABEL;
    for (const other of others[i]) {
      drawPad(context, other, values, { x: x0 + k * wide + GAP, y: below, k: small, full_n, marks: false });
      below += small * geometry(other).height + gap;
    }
    y += LABEL + k * high;
  });
  // The scale of the shades.
  const [bar, top] = [120, y + 9];
  for (let i = 0; i < bar; i += 4) {
    context.fillStyle = shadeOf((i / bar) ** 0.75);
    context.fillRect(x0 + i, top, 4, 8);
  }
  context.fillStyle = colour("muted");
  context.font = `13px ${FONT}`;
  context.textAlign = "left";
  context.fillText(t("measured.scale", { full: full_n }), x0 + bar + 8, top + 4);
  if (note) context.fillText(note, x0, top + 26);
}

// -- the last seconds -----------------------------------------------------------------------------

function niceTop(value) {
  const step = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 3, 4, 5, 6, 8, 10].map((n) => n * step).find((top) => value <= top * 1.0001);
}

function line(context, points, toX, toY) {
  context.beginPath();
  let last = null;
  for (const [t_s, value] of points) {
    if (value === null || value === undefined) { last = null; continue; }
    if (last === null || t_s - last > GAP_S) context.moveTo(toX(t_s), toY(value));
    else context.lineTo(toX(t_s), toY(value));
    last = t_s;
  }
  context.stroke();
}

// Times of contact: the set-point begins to rise.
function contacts(series) {
  return series.filter((sample, i) => i && sample.setpoint_n > 0 && !(series[i - 1].setpoint_n > 0)).map((sample) => sample.t_s);
}

export function drawChart(canvas, series, { begin_s, end_s, levels_n = [], cap_n = null, opening_max_mm = null, live = true }) {
  const surface = sized(canvas);
  if (!surface) return;
  const { context, width, height } = surface;
  const [left, right, top, bottom, between] = [46, 46, 18, 22, 26];
  const forceHigh = Math.round(0.64 * (height - top - bottom - between));
  const openTop = top + forceHigh + between;
  const openHigh = height - bottom - openTop;
  const highest = Math.max(1, ...levels_n, ...series.map((sample) => Math.max(sample.force_n ?? 0, sample.setpoint_n ?? 0)));
  const most_n = niceTop(highest * 1.05);
  const openings = series.map((sample) => sample.opening_mm).filter((mm) => mm != null);
  const most_mm = niceTop(Math.max(5, ...openings, live && opening_max_mm ? Math.min(opening_max_mm, 30) : 0));
  const toX = (t_s) => left + ((t_s - begin_s) / (end_s - begin_s)) * (width - left - right);
  const forceY = (n) => top + forceHigh * (1 - n / most_n);
  const openY = (mm) => openTop + openHigh * (1 - mm / most_mm);
  context.font = `13px ${FONT}`;
  context.textBaseline = "middle";
  const label = (text, x, y, align, name = "muted") => {
    context.fillStyle = colour(name);
    context.textAlign = align;
    context.fillText(text, x, y);
  };
  const rule = (y, name = "line", dash = []) => {
    context.strokeStyle = colour(name);
    context.lineWidth = 1;
    context.setLineDash(dash);
    context.beginPath();
    context.moveTo(left, Math.round(y) + 0.5);
    context.lineTo(width - right, Math.round(y) + 0.5);
    context.stroke();
    context.setLineDash([]);
  };
  for (const share of [0, 0.5, 1]) {
    rule(forceY(share * most_n));
    label(number(share * most_n), left - 8, forceY(share * most_n), "right");
  }
  for (const share of [0, 1]) {
    rule(openY(share * most_mm));
    label(number(share * most_mm), left - 8, openY(share * most_mm), "right");
  }
  label(t("measured.force_axis"), left, top - 10, "left");
  label(t("measured.opening_axis"), left, openTop - 10, "left");
  let free = Infinity;
  for (const level of [...new Set(levels_n)].sort((a, b) => a - b)) {
    const y = forceY(level);
    rule(y, "faint", [2, 4]);
    if (free - y > 13) {
      label(newtons(level), width - right + 5, y, "left");
      free = y;
    }
  }
  if (cap_n && cap_n <= most_n) rule(forceY(cap_n), "bad");
  const span = end_s - begin_s;
  const step = span > 6 ? 2 : span > 2.5 ? 1 : 0.5;
  for (let at = 0; at <= span + 1e-6; at += step) {
    const x = live ? toX(end_s - at) : toX(begin_s + at);
    const text = live && at ? `−${number(at)}` : number(at);
    label(at ? text : live ? t("measured.now") : "0", x, height - bottom / 2 + 2, "center");
  }
  context.save();
  context.beginPath();
  context.rect(left, 0, width - left - right, height);
  context.clip();
  const touched = contacts(series);
  for (const at of touched) {
    context.strokeStyle = colour("muted");
    context.lineWidth = 1;
    context.setLineDash([1, 3]);
    context.beginPath();
    context.moveTo(toX(at), top - 4);
    context.lineTo(toX(at), height - bottom);
    context.stroke();
    context.setLineDash([]);
    const right_edge = toX(at) > width - right - 70;
    // One name is enough; an axis with its own name needs none.
    if (at !== touched.at(-1) || toX(at) < left + 110) continue;
    label(t("measured.contact"), toX(at) + (right_edge ? -5 : 5), openTop - 10, right_edge ? "right" : "left");
  }
  context.lineJoin = "round";
  context.strokeStyle = colour("muted");
  context.lineWidth = 2;
  context.setLineDash([7, 5]);
  line(context, series.map((sample) => [sample.t_s, sample.setpoint_n]), toX, forceY);
  context.setLineDash([]);
  context.strokeStyle = colour("ink");
  context.lineWidth = 2.5;
  line(context, series.map((sample) => [sample.t_s, sample.force_n]), toX, forceY);
  context.strokeStyle = colour("accent");
  context.lineWidth = 2.5;
  line(context, series.map((sample) => [sample.t_s, sample.opening_mm]), toX, openY);
  context.restore();
}

// With empty fingers: the pads at the highest force of the last answer.
let lastGrasp = { number: null, frame: null };
function lastFrame({ state, link, changed }) {
  const its = state.shift?.answers?.at(-1)?.number ?? null;
  if (its !== lastGrasp.number) {
    lastGrasp = { number: its, frame: null };
    if (its !== null) link.call("GET", `api/grasps/${encodeURIComponent(its)}`, { timeout_ms: 5000 }).then((grasp) => {
      if (its !== lastGrasp.number || !grasp.frame) return;
      lastGrasp = { number: its, frame: Float32Array.from(grasp.frame) };
      changed();
    }).catch(() => {}); // the pads stay empty
  }
  return runs(state.job) || state.status.holding || state.fault ? null : lastGrasp.frame;
}

let described_s = 0;

export function renderMeasured(view) {
  const { state, info, link } = view;
  if (!state) return;
  const old = link.stale;
  const { live, status } = state;
  const value = (text) => (old ? "–" : text);
  setText(byId("measured_force"), value(newtons(live.force_n)));
  setText(byId("measured_setpoint"), value(newtons(live.setpoint_n || null)));  // 0: no force is controlled
  setText(byId("measured_opening"), value(millimetres(live.opening_mm)));
  setText(byId("measured_grip"), value(has(`grip.${status.grasp}`) ? t(`grip.${status.grasp}`) : status.grasp));
  const pads = info?.pads;
  const values = frame ?? lastFrame(view);
  const seen = Boolean(pads?.length) && values !== null && !old;
  show(byId("pads_none"), !seen);
  setText(byId("pads_none"), old ? t("measured.not_now") : t("measured.no_frames"));
  show(byId("pads"), Boolean(pads?.length) && (seen || old));
  if (seen) {
    scale_n = calmScale(Math.max(...values));
    drawPads(byId("pads"), pads, values, { full_n: scale_n, note: frame ? "" : t("measured.last") });
  } else sized(byId("pads"));
  const end_s = history.at(-1)?.t_s ?? 0;
  if (old) sized(byId("chart"));
  else {
    drawChart(byId("chart"), history, {
      begin_s: end_s - WINDOW_S, end_s, levels_n: info?.levels_n ?? [], cap_n: info?.force_cap_n,
      opening_max_mm: info?.opening_max_mm,
    });
  }
  const now_s = Date.now() / 1000;
  if (now_s - described_s > 2) {
    described_s = now_s;
    byId("pads").setAttribute("aria-label", t("measured.pads_say", { force: newtons(live.force_n) }));
    byId("chart").setAttribute("aria-label", t("measured.chart_say", {
      force: newtons(live.force_n), setpoint: newtons(live.setpoint_n || null), opening: millimetres(live.opening_mm),
    }));
  }
}
