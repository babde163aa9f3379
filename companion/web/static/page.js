// The operator's page, put together.

import { FlowChart } from "./chart.js";
import { Feed } from "./feed.js";
import { FieldMap } from "./map.js";
import { Orders, logIn } from "./orders.js";
import * as panels from "./panels.js";
import { ask, byId, kept, light, make, say } from "./part.js";
import { toSi, useUnits } from "./units.js";

let facts = {}, ground = null, state = null, scope = "none", checks = [];
const map = new FieldMap();
const chart = new FlowChart(byId("chart"));

const orders = new Orders(say);

function showMark() {
  const marks = [];
  if (state.simulated) marks.push("SIMULATED VEHICLE");
  if (facts.training === "water") marks.push("TRAINING WITH WATER");
  if (facts.training === "dry") marks.push("DRY RUN: nothing is sprayed");
  const box = byId("training");
  const text = marks.join(" · ");
  box.hidden = !text;
  if (box.textContent !== text) box.textContent = text;
}

function show() {
  if (!state || !ground) return;
  panels.showState(state);
  panels.showRates(state);
  panels.showNumbers(state, facts, ground);
  panels.showAlarms(state);
  panels.showLinks(state, facts, feed.age());
  panels.showChecklist(state, facts, ground, checks);
  panels.showTank(state, facts);
  panels.showDeclared(state, facts, scope);
  panels.showLanded(state, facts);
  panels.showEvents(state);
  orders.show(state, facts, scope);
  showMark();
  map.setVehicle(state.vehicle, state.duty);
  // For tests: which state the pixels show, once the browser has drawn them.
  const shown = state.now_s;
  requestAnimationFrame(() => { document.body.dataset.shown = String(shown); });
}

const feed = new Feed({
  onState(next) { state = next; chart.add(next); if (!document.hidden) show(); },
  onWay(points, from) { if (from === 0) map.setWay(points); else map.addPoints(points, from); },
  onLost(age) {
    const hasSession = scope !== "none";
    panels.showLost(age, hasSession && begun && performance.now() - begun > 2000);
    if (state && ground) panels.showLinks(state, facts, age);
  },
});

// What was observed: an empty field is not declared, an empty time is now, by this device's clock.
function declaration(form) {
  const given = Object.fromEntries([...new FormData(form)].filter(([, value]) => value !== ""));
  const at = given.observed_at ? new Date(given.observed_at) : new Date();
  for (const name of ["wind_m_s", "wind_from_deg", "temperature_c", "humidity_percent"]) if (name in given) given[name] = Number(given[name]);
  if ("wind_m_s" in given) given.wind_m_s = toSi("wind", given.wind_m_s);
  return { ...given, observed_at: `${at.toISOString().slice(0, 19)}Z` };
}

let begun = 0;
document.addEventListener("visibilitychange", () => { if (!document.hidden) show(); });

function theme() {
  map.setTheme(light());
  chart.restyle();
}

function settings() {
  byId("units").value = kept.get("units", "si");
  byId("theme").value = kept.get("theme", "auto");
  useUnits(byId("units").value);
  byId("units").addEventListener("change", (event) => {
    kept.set("units", event.target.value);
    useUnits(event.target.value);
    panels.showUnits(); map.legend(); chart.restyle(); show();
  });
  byId("theme").addEventListener("change", (event) => { kept.set("theme", event.target.value); theme(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", theme);
  panels.showUnits();
  byId("refill").addEventListener("submit", async (event) => {
    event.preventDefault();
    const litres = Number(byId("litres").value);
    if (litres >= 0 && (await orders.give("refilled", { litres: toSi("volume", litres) }))) byId("litres").value = "";
  });
  byId("declare").addEventListener("submit", (event) => { event.preventDefault(); orders.give("declare", declaration(event.target)); });
}

async function begin() {
  const access = await logIn();
  scope = access.scope;
  byId("session-note").textContent = !access.needs_token ? "This computer only: no login is needed."
    : scope === "none" ? "" : scope === "operate" ? "Logged in to operate." : "Logged in to look, and to stop.";
  if (scope === "none") {
    byId("state-word").textContent = "LOG IN";
    byId("state-line").textContent = "Open the link, or scan the QR code, that vrspray token show prints. STOP works without.";
    addEventListener("hashchange", () => location.reload());
    return;
  }
  begun = performance.now();
  feed.open();
  [facts, ground] = await Promise.all([ask("facts"), ask("map")]);
  byId("parts").replaceChildren(...(facts.parts ?? []).map(({ name, title }) => {
    const link = make("a", title);
    link.href = `${name}/`;
    return link;
  }));
  show();
  await map.load(ground, document.documentElement.dataset.theme);
  document.body.dataset.map = "ready";
  show();
  checks = await ask("checks").then((found) => found.checks, () => []);
  show();
}

settings();
theme();
navigator.wakeLock?.request("screen").catch(() => {});
begin().catch((error) => say(`${error.message}. Reload the page.`, true));
