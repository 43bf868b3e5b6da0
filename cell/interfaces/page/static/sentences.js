// Sentences of the commissioning in the language of the browser.

import { language, number } from "./words.js";

let sentences = []; // pattern of each English sentence, and its translation with {0} for the values

export async function loadSentences() {
  if (language === "en") return;
  const own = await (await fetch(new URL(`sentences.${language}.json`, import.meta.url))).json();
  // The longest pattern comes first.
  sentences = Object.entries(own).sort(([a], [b]) => b.length - a.length).map(([english, text]) => [
    new RegExp(`^${english.replace(/[.*+?^$()|[\]\\]/g, "\\$&").replace(/\{\d\}/g, "(.*?)")}$`, "s"), text]);
}

// Translates a text of the commissioning: the server sends English, translations are found by the
// pattern without values. Each item of a list is looked up; a text without pattern stays English.
export function spoken(text) {
  if (/^[+-]?[\d,]*\.?\d+$/.test(text)) {
    return text.replace(/[.,]/g, (sign) => (sign === "." ? number(1.5) : number(1000, 0))[1]);
  }
  const parts = text.split(/([,;] )/).map((part, at) => (at % 2 ? part : matched(part, true)));
  return parts.includes(undefined) ? matched(text, true) ?? matched(text, false) ?? text : parts.join("");
}

// `whole`: values that are English sentences are translated too.
function matched(text, whole) {
  for (const [pattern, own] of sentences) {
    const figures = pattern.exec(text)?.slice(1);
    if (!figures) continue;
    const found = figures.map(spoken);
    if (whole && found.some((figure, at) => figure === figures[at] && /[a-z]{2},? [\w.]/.test(figure))) continue;
    return own.replace(/\{(\d)\}/g, (_, at) => found[at]);
  }
  return undefined;
}
