// What the page and its parts have in common: their elements, what they say, what is kept, STOP and the light.

import { stopping } from "./orders.js";
import { useUnits } from "./units.js";

export { API, ask } from "./api.js";
export const byId = (id) => document.getElementById(id);

export function make(tag, text, className) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  return element;
}

export const kept = {
  get(name, otherwise) { try { return localStorage.getItem(`vrspray-${name}`) ?? otherwise; } catch { return otherwise; } },
  set(name, value) { try { localStorage.setItem(`vrspray-${name}`, value); } catch { /* private mode */ } },
};

let saying = 0;
export function say(what, isTrouble = false) {
  const box = byId("answer");
  box.textContent = what;
  box.hidden = false;
  clearTimeout(saying);
  saying = setTimeout(() => { box.hidden = true; }, isTrouble ? 8000 : 3000);
}

// Day or night, as it was chosen here or as the device has it.
export function light() {
  const chosen = kept.get("theme", "auto");
  const isNight = chosen === "night" || (chosen !== "day" && matchMedia("(prefers-color-scheme: dark)").matches);
  const theme = isNight ? "night" : "day";
  document.documentElement.dataset.theme = theme;
  return theme;
}

// For a part: light and units as chosen on the page; STOP works from here on. Returns the light.
export function begin() {
  useUnits(kept.get("units", "si"));
  stopping(byId("stop"), say);
  return light();
}
