// Texts in the language of the browser; numbers and times in its locale.

const LANGUAGES = ["en", "de"];
const tags = navigator.languages?.length ? navigator.languages : [navigator.language];
const locale = tags.find((tag) => LANGUAGES.includes(tag.slice(0, 2).toLowerCase())) ?? "en";
export const language = locale.slice(0, 2).toLowerCase();

let texts = {};
let faults = {};
let exact = {};
let simulated = {};
const plural = new Intl.PluralRules(locale);

export async function loadWords() {
  const answer = await fetch(new URL(`${language}.json`, import.meta.url));
  ({ faults = {}, exact = {}, simulated = {}, ...texts } = await answer.json());
  document.documentElement.lang = language;
  for (const node of document.querySelectorAll("[data-t]")) node.textContent = t(node.dataset.t);
}

// The text of a key, with `{name}` replaced; `n` chooses between `key.one` and `key.other`.
export function t(key, values = {}) {
  const numbered = values.n === undefined ? key : `${key}.${plural.select(values.n)}`;
  const text = texts[numbered] ?? texts[key];
  if (text === undefined) {
    console.error(`no text for ${numbered}`);
    return key;
  }
  return text.replace(/\{(\w+)\}/g, (_, name) =>
    typeof values[name] === "number" ? number(values[name]) : String(values[name] ?? ""));
}

export const has = (key) => key in texts;

// A fixed text of the server, for example a cause or a remedy: the server sends English, which is
// the key of the translation.
export const native = (text) => plain(exact[text] ?? text ?? "");

// Text without the marks of commands and keys: `zero`.
const plain = (text) => text.replaceAll("`", "");

// Text of a fault by its number; without a translation its English text.
export const faultText = ({ number: its, text = "" }) => plain(faults[its] ?? text);

// Meaning of a fault of the simulation; servos share texts, and so do axes.
export const faultMeaning = ({ name, meaning }) => simulated[name.replace(/^(servo|axis)\d+/, "$1N")] ?? meaning;

const formats = new Map();
function format(options) {
  const key = JSON.stringify(options);
  if (!formats.has(key)) formats.set(key, new Intl.NumberFormat(locale, options));
  return formats.get(key);
}

export function number(value, digits) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  // Values rounded to zero have no sign.
  return format({ minimumFractionDigits: digits, maximumFractionDigits: digits ?? 1, signDisplay: "negative" }).format(value);
}

export const newtons = (value) => (value == null ? "–" : `${number(value, 1)}\u00a0N`);
export const millimetres = (value, digits = 1) => (value == null ? "–" : `${number(value, digits)}\u00a0mm`);

export function percent(share) {
  if (share === null || share === undefined) return "–";
  // No answer is completely sure.
  const digits = share > 0.99 ? 1 : 0;
  const style = format({ style: "percent", minimumFractionDigits: digits, maximumFractionDigits: digits });
  return share > 0.999 ? `> ${style.format(0.999)}` : style.format(share);
}

const clockFormat = new Intl.DateTimeFormat(locale, { timeStyle: "medium" });
const shortClock = new Intl.DateTimeFormat(locale, { timeStyle: "short" });
export const clock = (unix_s) => clockFormat.format(new Date(1000 * unix_s));
export const clockShort = (unix_s) => shortClock.format(new Date(1000 * unix_s));

export function duration(seconds) {
  const whole = Math.max(0, Math.floor(seconds));
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min`;
  return `${number(Math.floor(whole / 3600))} h ${Math.floor((whole % 3600) / 60)} min`;
}
