// Everything beside the map: state, numbers, alarms, links, checklist, tank, events.

import { byId, make } from "./part.js";
import { unitOf, value, withUnit } from "./units.js";

const DUTIES_MAX = 8; // more figures do not fit on a phone
const FIXES = ["no GNSS", "no fix", "2D", "3D", "DGPS", "RTK float", "RTK fixed"];

function text(element, content) {
  if (element.textContent !== content) element.textContent = content;
}

// Builds a list anew only when what it shows has changed: screen readers and touches stay calm.
const shown = new Map();
function list(id, items, build) {
  const key = JSON.stringify(items);
  if (shown.get(id) === key) return;
  shown.set(id, key);
  byId(id).replaceChildren(...items.map(build));
}

export function showState(state) {
  const box = byId("state");
  if (box.dataset.state !== state.state) box.dataset.state = state.state;
  text(byId("state-word"), state.word);
  text(byId("state-line"), state.line);
  document.title = `${state.word} · vrspray`;
}

export function showLost(age, isKnown) {
  const isLost = isKnown && (age === null || age > 2);
  document.body.classList.toggle("stale", isLost);
  const banner = byId("lost");
  banner.hidden = !isLost;
  if (isLost) {
    text(banner, age === null ? "NO COMPANION" : `LINK LOST for ${age < 10 ? age.toFixed(0) : Math.round(age)} s. What you see is old. Use the transmitter's switch.`);
    text(byId("state-word"), "LINK LOST");
    text(byId("state-line"), "The page does not hear the companion.");
    byId("state").dataset.state = "none";
  }
}

export function showRates(state) {
  text(byId("n-target"), value("rate", state.target_l_ha));
  text(byId("n-actual"), value("rate", state.actual_l_ha));
  const duty = state.duty ?? [];
  const box = byId("valves");
  if (box.children.length !== duty.length) box.replaceChildren(...duty.map(() => { const one = make("div"); one.append(make("span")); return one; }));
  const figures = byId("duties");
  figures.hidden = duty.length > DUTIES_MAX;
  if (!figures.hidden) {
    if (figures.children.length !== duty.length) figures.replaceChildren(...duty.map(() => make("span")));
    duty.forEach((share, k) => text(figures.children[k], `${Math.round(share * 100)} %`));
  }
  duty.forEach((share, k) => { const height = `${Math.round(share * 100)}%`; const bar = box.children[k].firstElementChild; if (bar.style.height !== height) bar.style.height = height; });
  byId("key-metered").hidden = state.meter_l_min === null || state.meter_l_min === undefined;
  const open = duty.filter((share) => share > 0);
  box.setAttribute("aria-label", `${open.length} of ${duty.length} valves open`);
}

export function showNumbers(state, facts, ground) {
  const vehicle = state.vehicle ?? {}, liquid = state.liquid ?? {}, duty = state.duty ?? [];
  const open = duty.filter((share) => share > 0);
  const width = ground.boom.valves.reduce((sum, valve, k) => sum + ((duty[k] ?? 0) > 0 ? valve.width_m : 0), 0);
  const rows = [
    ["Ground speed", "speed", vehicle.speed_m_s],
    ["Height", "length", vehicle.height_m],
    ["Flow ordered", "flow", state.flow_l_min],
    ["Flow wanted", "flow", state.target_l_min],
    ...(facts.has_meter ? [["Flow metered", "flow", state.meter_l_min]] : []),
    ...(facts.has_pressure ? [["Pressure", "pressure", liquid.pressure_kpa]] : []),
    ["Active width", "length", width],
    ["Area done", "area", state.area_ha],
    ["Area left", "area", state.left_ha],
    ["Applied in all", "volume", state.volume_l],
    ["Wind", "wind", vehicle.wind_m_s],
  ].map(([name, kind, number]) => [name, value(kind, number), number === null || number === undefined ? "" : unitOf(kind)]);
  rows.splice(4, 0, ["Mean duty", open.length ? String(Math.round((open.reduce((a, b) => a + b, 0) / open.length) * 100)) : "–", open.length ? "%" : ""]);
  if (vehicle.rate_percent !== undefined && vehicle.rate_percent !== 100) rows.push(["Rate override", String(vehicle.rate_percent), "%"]);
  rows.push(["Mode", vehicle.mode ?? "–", vehicle.armed === false ? "disarmed" : vehicle.armed ? "armed" : ""]);
  const box = byId("numbers");
  if (box.children.length !== rows.length) {
    box.replaceChildren(...rows.map(([name]) => { const row = make("div"); const cell = make("dd"); cell.append(make("span"), make("i", undefined, "unit")); row.append(make("dt", name), cell); return row; }));
  }
  rows.forEach(([name, number, unit], k) => { const row = box.children[k]; text(row.children[0], name); text(row.children[1].children[0], number); text(row.children[1].children[1], unit); });
}

export function showAlarms(state) {
  const findings = (state.findings ?? []).map((one) => ({ ...one, advice: one.valve === null ? "" : `Valve ${one.valve + 1}.`, is_alarm: true }));
  const extra = [];
  if (state.journal?.fault) extra.push({ text: `record: ${state.journal.fault}`, advice: "Free the disk, or set journal.folder to another one.", is_alarm: true, since_s: state.since_s?.record });
  if (state.out_of_range) extra.push({ text: `${state.out_of_range} valves cannot deliver the rate at this speed`, advice: "Fly slower for more, faster for less.", is_alarm: true, since_s: state.since_s?.range });
  const items = [...findings, ...extra, ...(state.reasons ?? [])];
  list("alarms", items.length ? items : [{ text: "None. Nothing keeps the valves closed.", advice: "", is_alarm: false }], (one) => {
    const item = make("li", undefined, one.is_alarm ? "alarm" : "");
    item.append(make("b", one.text.charAt(0).toUpperCase() + one.text.slice(1)));
    item.append(make("time", undefined, "small"));
    if (one.advice) item.append(make("span", one.advice, "small"));
    return item;
  });
  items.forEach((one, k) => { if (one.since_s !== undefined) text(byId("alarms").children[k].children[1], `for ${lasting(state.now_s - one.since_s)}`); });
}

function lasting(seconds) {
  return seconds < 90 ? `${Math.max(Math.round(seconds), 0)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`;
}

function age(seconds) {
  return seconds === null || seconds === undefined ? "–" : seconds < 10 ? `${Math.max(seconds, 0).toFixed(1)} s` : `${Math.round(seconds)} s`;
}

export function showLinks(state, facts, pageAge) {
  const vehicle = state.vehicle ?? {}, link = state.link ?? {}, journal = state.journal ?? {};
  const within = (number, most) => number !== null && number !== undefined && number <= most;
  const calm = (seconds) => age(seconds === null || seconds === undefined ? seconds : seconds < 1 ? Math.ceil(seconds * 5) / 5 : Math.round(seconds));
  const items = [
    ["Page to companion", within(pageAge, 2), calm(pageAge), ""],
    ["Autopilot", vehicle.link_up !== false && within(vehicle.heartbeat_age_s, facts.heartbeat_age_max_s), calm(vehicle.heartbeat_age_s), link.position_hz ? `${Math.round(link.position_hz)} positions a second` : ""],
    ["Position", within(vehicle.position_age_s, facts.position_age_max_s), calm(vehicle.position_age_s), ""],
    ["GNSS", vehicle.fix !== null && vehicle.fix >= facts.fix, FIXES[vehicle.fix] ?? "–", [state.satellites === null || state.satellites === undefined ? "" : `${state.satellites} satellites`, vehicle.accuracy_m ? `± ${vehicle.accuracy_m.toFixed(2)} m` : ""].filter(Boolean).join(", ")],
    ["Autopilot's clock", Boolean(state.clock?.answers), state.clock ? (state.clock.answers ? "TIMESYNC" : "by arrival") : "–", state.clock?.round_trip_s ? `round trip ${Math.max(Math.round(state.clock.round_trip_s * 1000), 1)} ms` : ""],
    ["Record", Boolean(journal.name) && !journal.fault && !journal.lost, journal.fault ? "fault" : journal.lost ? `${journal.lost} rows lost` : journal.saved_age_s === undefined ? "writing" : calm(journal.saved_age_s), [journal.name, journal.free_gb === null || journal.free_gb === undefined ? "" : `${journal.free_gb < 10 ? journal.free_gb.toFixed(1) : Math.round(journal.free_gb)} GB free`].filter(Boolean).join(", ")],
  ];
  const receiver = state.receiver;
  if (receiver) items.push(["Receiver", receiver.is_usual, receiver.late_s === null ? "" : `${Math.round(receiver.late_s * 1000)} ms behind`, `${receiver.off_m === null ? "–" : receiver.off_m.toFixed(2)} m beside the estimator${receiver.late_s === null ? "" : "; the delay that the autopilot assumes"}`]);
  if (facts.has_meter) items.push(["Flow meter", !state.liquid?.meter_fault && state.liquid?.meter_ml !== null, state.liquid?.meter_fault ? "fault" : calm(state.liquid?.meter_age_s), state.liquid?.meter_fault ?? ""]);
  list("links", items, ([name, isOk, number, note]) => {
    const item = make("li", undefined, isOk ? "ok" : "bad");
    const mark = make("span", isOk ? "✓" : "✗", "mark");
    mark.setAttribute("role", "img"); mark.setAttribute("aria-label", isOk ? "good" : "bad");
    item.append(mark, make("b", name), make("span", number, "value"));
    if (note) item.append(make("span", note, "small"));
    return item;
  });
}

export function showChecklist(state, facts, ground, checks) {
  const vehicle = state.vehicle ?? {}, codes = new Set((state.reasons ?? []).map((one) => one.code));
  const none = (...names) => !names.some((name) => codes.has(name));
  const level = state.liquid?.tank_l ?? state.tank_counted_l;
  const live = [
    ["Flight map", ground.zone_count > 0, `${ground.zone_count} zones, ${withUnit("area", ground.field_m2 / 10000)}`],
    ["Vehicle heard", none("no-heartbeat", "stale-heartbeat", "link-lost", "not-active"), vehicle.mode ?? ""],
    ["Position good enough", none("no-position", "stale-position", "invalid-position", "position-frozen", "clock-disagrees", "fix-too-low", "accuracy-too-low", "estimator-unhealthy", "heading-unknown", "far-from-field"), FIXES[vehicle.fix] ?? ""],
    ["Outputs", none("output-fault", "unguarded", "leak", "valve-stuck-open", "no-flow", "flow-fault"), facts.output === "none" ? "no outputs: dry run" : facts.output],
    ["No stop pressed", none("estop", "rearm-needed"), ""],
    ["Wind", none("wind-above-max", "wind-unknown"), vehicle.wind_m_s === null || vehicle.wind_m_s === undefined ? `not measured; at most ${withUnit("wind", facts.wind_max_m_s)}` : withUnit("wind", vehicle.wind_m_s)],
    ["Tank", level === null || level === undefined ? null : level > (facts.reserve_l ?? 0), level === null || level === undefined ? "enter what is in it under Tank" : withUnit("volume", level)],
    ["Record", !state.journal?.fault, state.journal?.name ?? ""],
    ["Product", facts.training !== "no" ? null : Boolean(facts.product), facts.training === "no" ? facts.product || "product.name is not set" : `training: ${facts.training}`],
  ];
  const items = [...live, ...(checks ?? []).filter((one) => one.status === "warn" || one.status === "fail").map((one) => [one.name, one.status === "fail" ? false : null, one.fix ? `${one.text}; ${one.fix}` : one.text])];
  list("checklist", items, ([name, isOk, note]) => {
    const item = make("li", undefined, isOk === null ? "wait" : isOk ? "ok" : "bad");
    const mark = make("span", isOk === null ? "•" : isOk ? "✓" : "✗", "mark");
    mark.setAttribute("role", "img"); mark.setAttribute("aria-label", isOk === null ? "to see to" : isOk ? "good" : "bad");
    item.append(mark, make("b", name));
    if (note) item.append(make("span", note, "small"));
    return item;
  });
}

export function showTank(state, facts) {
  const level = state.liquid?.tank_l ?? state.tank_counted_l;
  const bar = byId("tank-bar"), full = facts.tank_l;
  const share = level !== null && level !== undefined && full ? Math.min(level / full, 1) : 0;
  bar.firstElementChild.style.width = `${Math.round(share * 100)}%`;
  const flow = state.meter_l_min ?? state.flow_l_min;
  const isLow = level !== null && level !== undefined && level <= Math.max(facts.reserve_l ?? 0, 0.1 * (full ?? 0));
  bar.classList.toggle("low", isLow);
  const parts = [level === null || level === undefined ? "Not known: enter what is in it." : `${withUnit("volume", level)}${full ? ` of ${withUnit("volume", full)}` : ""}`];
  if (level !== null && level !== undefined && flow > 0.05) parts.push(`${(level / flow).toFixed(1)} min at this flow`);
  if (level !== null && level !== undefined && !facts.has_tank_sensor) parts.push("counted down by the ordered flow");
  text(byId("tank-text"), parts.join(" · "));
  bar.setAttribute("aria-label", parts[0]);
}

// What the operator declares: each limit that no sensor watches, and the form, on the ground.
export function showDeclared(state, facts, scope) {
  byId("declare-card").hidden = !facts.asks;
  if (!facts.asks) return;
  list("declared", state.declared?.rows ?? [], ([name, words, value, isKept]) => {
    const item = make("li", undefined, isKept ? "ok" : "bad");
    const mark = make("span", isKept ? "✓" : "✗", "mark");
    mark.setAttribute("role", "img"); mark.setAttribute("aria-label", isKept ? "kept" : "not kept");
    item.append(mark, make("b", name), make("span", value === null ? "not declared" : String(value), "value"), make("span", words, "small"));
    return item;
  });
  const may = scope === "operate" && state.vehicle?.armed !== true;
  for (const item of byId("declare").elements) if (item.disabled === may) item.disabled = !may;
  text(byId("declare-note"), !may ? "Declare on the ground, disarmed, with the operator's link."
    : `${facts.limits ?? "For the record"}. Each time declare all that you observed; an empty time is now.`);
}

// After landing: what was done, and the way to the report of this flight.
export function showLanded(state, facts) {
  const isLanded = state.vehicle?.armed === false && state.point_count > 0;
  byId("landed").hidden = !isLanded;
  if (!isLanded) return;
  text(byId("landed-text"), `${withUnit("area", state.area_ha)} treated with ${withUnit("volume", state.volume_l)} ordered; ${withUnit("area", state.left_ha)} left.`);
  const box = byId("landed-link"), name = state.journal?.name;
  if (box.firstChild || !name || !(facts.parts ?? []).some((one) => one.name === "flights")) return;
  const link = make("a", "Report, and what is left");
  link.href = `flights/#report=${encodeURIComponent(name)}`;
  box.append(link);
}

export function showEvents(state) {
  list("events", (state.events ?? []).slice().reverse(), ([at, kind, what]) => {
    const item = make("li");
    const gone = Math.max(state.now_s - at, 0);
    item.append(make("time", gone < 90 ? `${Math.round(gone)} s ago` : `${Math.round(gone / 60)} min`), make("span", what || kind));
    return item;
  });
}

export function showUnits() {
  for (const element of document.querySelectorAll("[data-unit]")) element.textContent = unitOf(element.dataset.unit);
  shown.clear();
}
