// The office on the page: files in, the map's check, areas drawn, the plan, and what to do with it.

import { API, ask, begin, byId, make, say } from "../static/part.js";
import { toSi, unitOf, value, withUnit } from "../static/units.js";
import { OfficeMap } from "./office-map.js";

const KINDS = { swath_m: "length", speed_m_s: "speed", tank_l: "volume", rate_l_ha: "rate", border_m: "length" };
const ROLES = { boundary: "drawn-boundary.geojson", "no-spray": "drawn-no-spray.geojson" };
const chosenBy = {}; // by the operator: which file is what
let state = { files: [], made: [] }, corners = [], role = null;

// One thing at a time; what comes back is the whole state of the office.
async function doing(word, work) {
  document.body.dataset.busy = word;
  for (const button of document.querySelectorAll("main button")) button.disabled = true;
  say(`${word} …`);
  try {
    state = await work();
    say(`${word}: done`);
  } catch (error) {
    say(error.message, true);
    state = await ask("office").catch(() => state);
  }
  for (const button of document.querySelectorAll("main button")) button.disabled = false;
  delete document.body.dataset.busy;
  show();
}

function choices(select, names, chosen) {
  const before = select.multiple ? new Set([...select.selectedOptions].map((one) => one.value)) : new Set([chosen ?? select.value]);
  select.replaceChildren(...names.map(([value, text]) => { const one = new Option(text, value); one.selected = before.has(value); return one; }));
}

function showFiles() {
  byId("files").replaceChildren(...state.files.map((file) => {
    const item = make("li"), button = make("button", "Remove");
    button.type = "button";
    button.setAttribute("aria-label", `Remove ${file.name}`);
    button.addEventListener("click", () => doing("Removing", () => ask("office/remove", { file: file.name })));
    item.append(make("span", `${file.name} · ${file.bytes < 1e6 ? `${(file.bytes / 1e3).toFixed(1)} kB` : `${(file.bytes / 1e6).toFixed(1)} MB`}`), button);
    return item;
  }));
  const maps = state.files.map((file) => file.name).filter((name) => !/[.](shx|dbf|prj|cpg|bin)$/i.test(name));
  const named = maps.map((name) => [name, name]);
  const has = (text) => maps.find((name) => name.toLowerCase().includes(text));
  // What the operator chose stays; else each file goes where its name says.
  const kept = (id) => (maps.includes(chosenBy[id]) || chosenBy[id] === "" ? chosenBy[id] : undefined);
  choices(byId("prescription"), [["", "none: one rate"], ...named], kept("prescription") ?? has("presc") ?? "");
  choices(byId("field"), named, kept("field") ?? has("bound") ?? maps.find((name) => name !== byId("prescription").value) ?? maps[0]);
  const isData = (name) => /[.](tiff?|csv|parquet)$/i.test(name);
  choices(byId("no_spray"), named.filter(([name]) => !isData(name) && name !== byId("prescription").value && name !== byId("field").value));
  choices(byId("data"), named, kept("data") ?? maps.find(isData) ?? maps[0]);
  choices(byId("done"), [["", "nothing: the whole field"], ...(state.flights ?? []).map((name) => [name, name])], byId("done").value || wanted);
}

function refused(text) { return make("p", text, "refused"); }

function problemList(found) {
  const list = make("ul");
  list.append(...(found.problems ?? []).map((one) => make("li", `${one.severity}: ${one.text}${one.fix ? `; ${one.fix}` : ""}`)));
  return list;
}

function tableOf(heads, rows) {
  const table = make("table"), head = make("tr");
  head.append(...heads.map((text) => { const cell = make("th", text); cell.scope = "col"; return cell; }));
  table.append(head, ...rows.map((cells) => {
    const row = make("tr");
    row.append(...cells.map((text) => make("td", String(text))));
    return row;
  }));
  return table;
}

function showMade() {
  const box = byId("make"), done = state.make;
  if (!done) { box.replaceChildren(); return; }
  if (done.error) { box.replaceChildren(refused(done.error)); return; }
  const found = done.found;
  if (done.kind === "spots") { box.replaceChildren(...spotParts(done.file, found)); return; }
  if (done.kind === "trial") { box.replaceChildren(...trialParts(done.file, found)); return; }
  const cleaned = found.values.filter((one) => one.removed);
  box.replaceChildren(
    make("p", `${done.file}: ${withUnit("volume", found.litres)}; ${found.misapplied_percent.toFixed(1)} % of what the data ask for lies elsewhere, so that the sprayer can follow. Course ${found.course_deg.toFixed(1)}°. Now check the map.`),
    tableOf(["Zone", "Rate", "Area", "Value"], found.zones.map((one, k) => [k + 1, withUnit("rate", one.rate_l_ha), withUnit("area", one.area_ha), one.mean_value.toPrecision(4)])),
    ...cleaned.map((one) => make("p", `${one.points} points; left out: ${Object.entries(one.removed).filter(([, count]) => count).map(([why, count]) => `${why} ${count}`).join(", ") || "none"}.`, "small")),
    ...found.steps.map((one) => make("p", `${one.name}: ${withUnit("area", one.changed_ha)} changed, ${withUnit("volume", one.moved_l)} moved.`, "small")),
    ...found.notes.map((text) => make("p", text, "small")), problemList(found),
  );
}

function spotParts(file, found) {
  return [
    make("p", `${file}: ${found.weeds} weeds in ${found.spots} spots, ${withUnit("area", found.treated_ha)} treated with ${withUnit("volume", found.litres)}; ${found.saved_percent.toFixed(1)} % saved. ${found.expected_misses.toFixed(1)} weeds may be missed. Course ${found.course_deg.toFixed(1)}°. Now check the map.`),
    make("p", `Around each weed ${withUnit("length", found.budget.along_m)} along and ${withUnit("length", found.budget.across_m)} across: ${found.budget.parts.map((one) => one.name).join(", ")}.`, "small"),
    ...(found.beyond ? [make("p", `${found.beyond} weeds lie outside and are left out.`, "refused")] : []),
    ...found.warnings.map((text) => make("p", text, "refused")), problemList(found),
  ];
}

function trialParts(file, found) {
  const blocks = [...new Set(found.plots.map((one) => one.block))];
  const link = make("a", "Keep its plots for the evaluation");
  link.href = `${API}office/made/made-prescription.trial.geojson`;
  link.download = "made-prescription.trial.geojson";
  const kept = make("p");
  kept.append(link);
  return [
    make("p", `${file}: ${found.plots.length} plots in ${found.blocks} blocks, seed ${found.seed}. Course ${found.course_deg.toFixed(1)}°. Now check the map.`),
    tableOf(["Block", "Plot: rate"], blocks.map((block) => [block, found.plots.filter((one) => one.block === block).map((one) => `${one.plot}: ${value("rate", one.rate_l_ha)}`).join(", ")])),
    kept, problemList(found),
  ];
}

function showCheck() {
  const box = byId("check"), check = state.check;
  if (!check) { box.replaceChildren(); return; }
  const found = check.found ?? {}, list = problemList(found);
  if (check.error) { box.replaceChildren(refused(check.error)); return; }
  box.replaceChildren(make("p", `${check.file}: ${found.zones} zones, ${withUnit("area", found.area_ha)}, ${withUnit("volume", found.litres)}, ${withUnit("rate", Math.min(...found.rates_l_ha))} to ${withUnit("rate", Math.max(...found.rates_l_ha))}.`), list.children.length ? list : make("p", "Nothing wrong was found.", "small"));
}

function sortieTable(found) {
  const table = tableOf(["Sortie", "Volume", "Fill to", "Minutes", "Passes"], found.sorties.map((one) => [one.number, withUnit("volume", one.volume_l), withUnit("volume", one.fill_l), (one.airborne_s / 60).toFixed(1), one.swaths]));
  found.sorties.forEach((one, k) => { table.rows[k + 1].cells[0].style.borderLeft = `6px solid ${map.colorOf(one.number)}`; });
  return table;
}

// What to pour before each sortie, from top to bottom; products in their own unit.
function mixParts(mix) {
  if (!mix) return [];
  const litres = (name, of) => [`${name}, ${unitOf("volume")}`, ...mix.sorties.map((one) => value("volume", one[of]))];
  const rows = mix.products.map((product, k) => {
    const amounts = mix.sorties.map((one) => one.amounts[k]), isSmall = Math.max(...amounts) < 1;
    const unit = isSmall ? { L: "mL", kg: "g" }[product.measure] : product.measure;
    return [`${product.name}, ${unit}`, ...amounts.map((amount) => (isSmall ? (amount * 1000).toFixed(1) : amount.toFixed(3)))];
  });
  const wide = make("div", undefined, "wide");
  wide.tabIndex = 0; // there may be more sorties than fit
  wide.append(tableOf(["Mix for sortie", ...mix.sorties.map((one) => one.number)], [litres("Half of the water", "water_first_l"), ...rows, litres("Water up to", "mix_l")]));
  return [
    wide,
    ...mix.notes.map((text) => make("p", text, "small")),
  ];
}

function showPlan() {
  const box = byId("plan"), plan = state.plan;
  if (!plan) { box.replaceChildren(); return; }
  if (plan.error) { box.replaceChildren(refused(plan.error)); return; }
  const found = plan.found, parts = [
    make("p", `${found.sorties.length} ${found.sorties.length === 1 ? "sortie" : "sorties"}, ${withUnit("volume", found.volume_l)}, ${(found.sorties.reduce((sum, each) => sum + each.airborne_s, 0) / 60).toFixed(0)} min in the air; ${found.treated_percent === null ? `${found.coverage_percent.toFixed(1)} % covered` : `${found.treated_percent.toFixed(1)} % treated, ${withUnit("area", found.bare_m2 / 1e4)} bare`}.`),
    sortieTable(found), ...mixParts(found.mix), ...found.warnings.map((text) => make("p", text, "refused")),
  ];
  if (plan.flight_map?.error) parts.push(refused(`flight map: ${plan.flight_map.error}`));
  else if (plan.flight_map && state.no_choice) parts.push(make("p", "To fly it, set this in the configuration, and start run again:", "small"), make("pre", Object.entries(plan.flight_map.settings).map(([key, value]) => `${key} = ${value.startsWith("[") ? value : JSON.stringify(value)}`).join("\n")));
  const links = make("p");
  for (const file of state.made) {
    const link = make("a", file.name);
    link.href = `${API}office/made/${encodeURIComponent(file.name)}`;
    link.download = file.name;
    links.append(link);
  }
  parts.push(links);
  for (const name of state.uploads ? plan.files : []) {
    const button = make("button", `Upload ${name} to the vehicle`);
    button.type = "button";
    button.addEventListener("click", () => doing("Uploading", () => ask("office/upload", { file: name })));
    parts.push(button);
  }
  if (!state.uploads) parts.push(make("p", "To upload from here, set web.upload_link; or load the file into your ground station.", "small"));
  if (state.upload) parts.push(state.upload.error ? refused(state.upload.error) : make("p", `${state.upload.file}: on the vehicle, read back and the same.`));
  box.replaceChildren(...parts);
}

// Another field: the companion ends on the ground, and comes back with it.
function showFly() {
  const names = ["", ...(state.fields ?? [])], last = state.plan?.flight_map?.field;
  choices(byId("fly-field"), names.map((name) => [name, name || "the configuration's own"]), last && chosenBy.fly === undefined ? last : undefined);
  byId("fly-note").textContent = `Flown now: ${state.flown || "the configuration's own field"}. ${state.no_choice ? `${state.no_choice[0].toUpperCase()}${state.no_choice.slice(1)}.` : "Upload its mission, too."}`;
  byId("fly-button").disabled = Boolean(state.no_choice);
}

async function fly() {
  const field = byId("fly-field").value;
  let isTaken = false;
  await doing("Changing the field", async () => { const next = await ask("office/fly", { field: field || null }); isTaken = true; return next; });
  for (let k = 0; isTaken && k < 60; k += 1) {
    say("The companion starts again …");
    await new Promise((resolve) => setTimeout(resolve, 1000));
    const next = await ask("office").catch(() => null);
    if (next && !next.task && (next.flown === field)) { state = next; show(); say("The field was changed."); return; }
  }
  if (isTaken) say("The companion did not come back: look at its log.", true);
}

function show() {
  const box = byId("not-now");
  box.hidden = !state.not_now;
  box.textContent = state.not_now ? `Not now: ${state.not_now}.` : "";
  showFiles(); showMade(); showCheck(); showPlan(); showFly();
  byId("draw-save").disabled = corners.length < 3 || !role;
  byId("draw-edit").disabled = !byId("field").value.endsWith(".geojson");
  const lines = state.made.find((file) => file.name.endsWith(".lines.geojson"));
  const place = (folder, name) => new URL(`${API}office/${folder}/${encodeURIComponent(name)}`, document.baseURI).href;
  map.showFiles({
    zones: state.check?.zones ? place("made", "zones.geojson") : null,
    lines: lines ? place("made", lines.name) : null,
    field: byId("field").value.endsWith("json") ? place("given", byId("field").value) : null,
    rates: state.check?.found?.rates_l_ha ?? [],
  });
}

function textOf(found) { return found.map(([lng, lat]) => `${lat.toFixed(7)}, ${lng.toFixed(7)}`).join("\n"); }

function cornersOf(text) {
  return text.split("\n").filter((line) => line.trim()).map((line) => line.split(/[,;\s]+/).filter(Boolean).map(Number))
    .filter(([lat, lng]) => Math.abs(lat) <= 90 && Math.abs(lng) <= 180).map(([lat, lng]) => [lng, lat]);
}

function draw(found, isTyped = false) {
  corners = found;
  if (!isTyped) byId("corners").value = textOf(found);
  byId("draw-save").disabled = corners.length < 3 || !role;
  map.showCorners(corners);
}

function startDrawing(wanted, found = []) {
  role = wanted;
  for (const name of Object.keys(ROLES)) byId(`draw-${name}`).setAttribute("aria-pressed", String(name === role));
  map.draws = Boolean(role);
  draw(found);
}

async function save() {
  const ring = [...corners, corners[0]];
  const data = { type: "FeatureCollection", features: [{ type: "Feature", properties: {}, geometry: { type: "Polygon", coordinates: [ring] } }] };
  let name = ROLES[role];
  for (let k = 2; role === "no-spray" && state.files.some((file) => file.name === name); k += 1) name = `drawn-no-spray-${k}.geojson`;
  const chosen = role;
  await doing("Saving", () => ask(`office/files/${name}`, JSON.stringify(data), { kind: "application/octet-stream" }));
  if (chosen === "boundary") chosenBy.field = name;
  else for (const one of byId("no_spray").options) if (one.value === name) one.selected = true;
  startDrawing(null);
  show();
}

async function edit() {
  const data = await ask(`office/given/${encodeURIComponent(byId("field").value)}`).catch(() => null);
  const shape = data?.features?.[0]?.geometry ?? data?.geometry ?? data;
  const ring = shape?.type === "Polygon" ? shape.coordinates[0] : shape?.type === "MultiPolygon" ? shape.coordinates[0][0] : null;
  if (!ring || ring.length > 400) { say("This boundary cannot be edited here: it is not a polygon, or has over 400 corners.", true); return; }
  startDrawing("boundary", ring.slice(0, -1).map(([lng, lat]) => [lng, lat]));
}

function reading() {
  return Object.fromEntries(["rate_field", "unit"].map((id) => [id, byId(id).value.trim()]).filter(([, value]) => value));
}

async function load(list) {
  for (const file of list) await doing(`Loading ${file.name}`, () => ask(`office/files/${encodeURIComponent(file.name)}`, file, { kind: "application/octet-stream" }));
}

function planned() {
  const body = { field: byId("field").value, kind: byId("kind").value, holes: byId("holes").value, no_spray: [...byId("no_spray").selectedOptions].map((one) => one.value), ...reading() };
  if (byId("prescription").value) body.prescription = byId("prescription").value;
  if (byId("done").value) body.done = byId("done").value;
  for (const [id, kind] of Object.entries(KINDS)) if (byId(id).value !== "") body[id] = toSi(kind, Number(byId(id).value));
  if (byId("angle_deg").value !== "") body.angle_deg = Number(byId("angle_deg").value);
  if (byId("depot").value.trim()) body.depot = byId("depot").value.split(/[,;\s]+/).filter(Boolean).map(Number).slice(0, 2);
  return body;
}

function wish() {
  const rates = byId("rates").value.split(/[,;\s]+/).filter(Boolean).map((text) => toSi("rate", Number(text)));
  const kind = byId("make-kind").value;
  const body = { kind, rates_l_ha: rates, field: byId("field").value, no_spray: [...byId("no_spray").selectedOptions].map((one) => one.value) };
  if (kind !== "trial") body.data = byId("data").value;
  if (kind === "zones") body.across = byId("across").value;
  if (kind === "zones" && byId("value").value.trim()) body.value = byId("value").value.trim();
  const numbers = { zones: { litres_max: "volume" }, spots: { wind_m_s: "wind" }, trial: { rest_l_ha: "rate", plot_m: "length", blocks: null, seed: null } }[kind];
  for (const [id, unit] of Object.entries(numbers)) if (byId(id).value !== "") body[id] = unit ? toSi(unit, Number(byId(id).value)) : Number(byId(id).value);
  if (byId("angle_deg").value !== "") body.angle_deg = Number(byId("angle_deg").value);
  return body;
}

async function makeZones() {
  const body = wish();
  if (!body.rates_l_ha.length || body.rates_l_ha.some(Number.isNaN)) { say("Rates are numbers, one for each zone: 26 22 18 14.", true); return; }
  if (!body.field || (body.kind !== "trial" && (!body.data || body.data === body.field))) { say("Load the data and a boundary, or draw the boundary.", true); return; }
  if (body.kind === "trial" && body.rest_l_ha === undefined) { say("Enter the rate for the ground around the plots.", true); return; }
  await doing(byId("make-button").textContent.replace("Make", "Making"), () => ask("office/make", body));
  if (!state.make || state.make.error) return;
  // The zones fit these passes and no others.
  chosenBy.prescription = state.make.file;
  byId("angle_deg").value = state.make.found.course_deg;
  show();
}

const theme = begin();
for (const element of document.querySelectorAll("[data-unit]")) element.textContent = unitOf(element.dataset.unit);
// From the report of a flight: what it left is planned.
let wanted = new URLSearchParams(location.hash.slice(1)).get("done") ?? "";

const map = new OfficeMap(byId("map"), theme, {
  onClick(place) { if (role) draw([...corners, place]); },
  onMove(index, place) { draw(corners.map((one, k) => (k === index ? place : one))); },
});
byId("pick").addEventListener("change", async (event) => { await load([...event.target.files]); event.target.value = ""; });
byId("make-kind").addEventListener("change", () => {
  const kind = byId("make-kind").value;
  for (const one of document.querySelectorAll("#make-form [data-for]")) one.hidden = !one.dataset.for.split(" ").includes(kind);
  byId("make-button").textContent = { zones: "Make zones", spots: "Make spots", trial: "Make a trial" }[kind];
  byId("rates").placeholder = { zones: "lowest value first: 26 22 18", spots: "20", trial: "15 20 25" }[kind];
});
byId("make-form").addEventListener("submit", (event) => { event.preventDefault(); makeZones(); });
byId("check-form").addEventListener("submit", (event) => { event.preventDefault(); if (byId("prescription").value) doing("Checking", () => ask("office/check", { file: byId("prescription").value, ...reading() })); });
byId("plan-form").addEventListener("submit", (event) => { event.preventDefault(); if (byId("field").value) doing("Planning", () => ask("office/plan", planned())); });
for (const name of Object.keys(ROLES)) byId(`draw-${name}`).addEventListener("click", () => startDrawing(role === name ? null : name));
byId("draw-undo").addEventListener("click", () => draw(corners.slice(0, -1)));
byId("draw-save").addEventListener("click", save);
byId("draw-edit").addEventListener("click", edit);
byId("fly-form").addEventListener("submit", (event) => { event.preventDefault(); fly(); });
byId("fly-field").addEventListener("change", () => { chosenBy.fly = byId("fly-field").value; });
byId("corners").addEventListener("input", (event) => draw(cornersOf(event.target.value), true));
for (const id of ["prescription", "field", "data"]) byId(id).addEventListener("change", () => { chosenBy[id] = byId(id).value; show(); });

state = await ask("office").catch((error) => { say(error.message, true); return state; });
await map.ready;
byId("map-note").hidden = map.works;
show();
wanted = "";
document.body.dataset.office = "ready";
setInterval(async () => { // the vehicle may be armed meanwhile
  if (document.body.dataset.busy || document.hidden) return;
  const next = await ask("office").catch(() => null);
  if (next && next.not_now !== state.not_now) { state = next; show(); }
}, 2000);
