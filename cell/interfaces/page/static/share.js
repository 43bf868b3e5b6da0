// The view-only link for a second person.

import { byId, drawing, setText, show } from "./dom.js";

// The rights of this page, and the link: requested again with each connection.
export async function askAccess(view) {
  const { commands, address, note, qr } = await view.link.call("GET", "api/access", { timeout_ms: 5000 });
  view.link.viewOnly = !commands;
  setText(byId("share_address"), address);
  byId("share_address").href = address;
  show(byId("share_note"), Boolean(note));
  byId("share_qr").toggleAttribute("hidden", Boolean(note));
  const size = qr.length + 8;
  const path = qr.flatMap((row, y) => [...row].map((dark, x) => (dark === "1" ? `M${x + 4} ${y + 4}h1v1h-1z` : ""))).join("");
  byId("share_qr").setAttribute("viewBox", `0 0 ${size} ${size}`);
  byId("share_qr").replaceChildren(drawing("rect", { width: size, height: size, fill: "#fff" }), drawing("path", { d: path, fill: "#000" }));
}

export function setupShare(view) {
  byId("share_open").addEventListener("click", () => byId("share").show());
  byId("share_close").addEventListener("click", () => byId("share").close());
  view.askAccess = () => askAccess(view);
}

export function renderShare({ link, state }) {
  show(byId("share_open"), Boolean(state));
  show(byId("view_only"), Boolean(link.viewOnly));
  show(byId("command"), !link.viewOnly);
}
