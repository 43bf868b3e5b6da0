// Small helpers for the page: every text goes in as text, never as HTML.

export const byId = (id) => document.getElementById(id);

export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

export function show(node, visible) {
  if (node.hidden !== visible) return;
  const focused = !visible && node.contains(document.activeElement);
  node.hidden = !visible;
  if (focused) byId("state").focus();  // a screen reader reads what is new
}

// One element with attributes; its children are nodes or texts.
export function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

export function drawing(tag, attributes = {}) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}

// A list is rebuilt only when its content has changed: focus and pointer stay.
const contents = new WeakMap();
export function renew(node, value, makeChildren) {
  const now = JSON.stringify(value);
  if (contents.get(node) === now) return;
  contents.set(node, now);
  node.replaceChildren(...makeChildren());
}

// A button that can be focused and read while it is not allowed; it shows the reason.
export function allow(button, word, hint, reason) {
  const key = `${word}|${hint}|${reason}`;
  if (contents.get(button) === key) return;
  contents.set(button, key);
  button.setAttribute("aria-disabled", reason ? "true" : "false");
  button.replaceChildren(make("b", {}, word), make("span", {}, reason || hint));
}

export const isAllowed = (button) => button.getAttribute("aria-disabled") !== "true";

// Call `act` after `button` was pressed for `seconds` by pointer or key; its bar shows the time.
export function onLongPress(button, seconds, act) {
  let timer = 0;
  const begin = (event) => {
    if (timer || !isAllowed(button)) return;
    if (event.type === "keydown" && (![" ", "Enter"].includes(event.key) || event.repeat)) return;
    if (event.type === "pointerdown" && event.button !== 0) return;
    button.classList.add("pressed");
    timer = setTimeout(() => {
      end();
      if (isAllowed(button)) act();
    }, 1000 * seconds);
  };
  const end = () => {
    clearTimeout(timer);
    timer = 0;
    button.classList.remove("pressed");
  };
  for (const name of ["pointerdown", "keydown"]) button.addEventListener(name, begin);
  for (const name of ["pointerup", "pointerleave", "pointercancel", "keyup", "blur"]) {
    button.addEventListener(name, end);
  }
  button.addEventListener("contextmenu", (event) => event.preventDefault());
  // A key clicks a button once on release: that is no long press.
  button.addEventListener("click", (event) => event.preventDefault());
}

// Resize a canvas to its size in CSS pixels; returns its context, or null while it is hidden.
export function sized(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  if (!width || !height) return null;
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

let colours = null;
export function colour(name) {
  colours ??= getComputedStyle(document.documentElement);
  return colours.getPropertyValue(`--${name}`).trim();
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => (colours = null));

// A question before an action that cannot be undone.
export function ask(text, word, act) {
  setText(byId("sure_text"), text);
  setText(byId("sure_yes"), word);
  byId("sure_yes").onclick = () => {
    byId("sure").close();
    act();
  };
  if (!byId("sure").open) byId("sure").show();
}
