// What the parts of the page have in common: their elements, what they say and ask, STOP and the light.

import { stopping } from "./orders.js";
import { useUnits } from "./units.js";

export const API = "../api/v1/";
export const byId = (id) => document.getElementById(id);

export function make(tag, text, className) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  return element;
}

let saying = 0;
export function say(what, isTrouble = false) {
  const box = byId("answer");
  box.textContent = what;
  box.hidden = false;
  clearTimeout(saying);
  saying = setTimeout(() => { box.hidden = true; }, isTrouble ? 8000 : 3000);
}

export async function ask(place, body, kind = "application/json") {
  const options = body === undefined ? {} : { method: "POST", headers: { "Content-Type": kind }, body: kind === "application/json" ? JSON.stringify(body) : body };
  const response = await fetch(`${API}${place}`, { credentials: "same-origin", ...options });
  const answer = await response.json().catch(() => ({}));
  if (!response.ok) throw new Error(typeof answer.detail === "string" ? answer.detail : `refused (${response.status})`);
  return answer;
}

// The light and the units that were chosen on the page; STOP works from here on. Returns the light.
export function begin() {
  let chosen = null;
  try { chosen = localStorage.getItem("vrspray-theme"); useUnits(localStorage.getItem("vrspray-units") ?? "si"); } catch { /* private mode */ }
  const isNight = matchMedia("(prefers-color-scheme: dark)").matches;
  const theme = chosen === "night" || (chosen !== "day" && isNight) ? "night" : "day";
  document.documentElement.dataset.theme = theme;
  stopping(byId("stop"), say);
  return theme;
}
