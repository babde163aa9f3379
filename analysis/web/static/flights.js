// Flights on the page: their list, a flight's report, what it left, and how to go on.

import { API, ask, begin, byId, make, say } from "../static/part.js";
import { withUnit } from "../static/units.js";

let state = {}, facts = {};

async function doing(word, work) {
  document.body.dataset.busy = word;
  for (const button of document.querySelectorAll("main button")) button.disabled = true;
  say(`${word} …`);
  const waiting = setInterval(() => say(`${word} …`), 2500);
  try {
    state = await work();
    byId("answer").hidden = true;
  } catch (error) {
    say(error.message, true);
    state = await ask("flights").catch(() => state);
  }
  clearInterval(waiting);
  delete document.body.dataset.busy;
  show();
}

const report = (file, also = []) => doing("Writing the report", () => ask("flights/report", { file, also }));

function markOf(flight) {
  const marks = [];
  if (flight.simulated === "yes" || flight.training === "simulated") marks.push("SIMULATED");
  if (flight.training === "water" || flight.training === "dry") marks.push(flight.training === "water" ? "WATER" : "DRY RUN");
  return marks.join(" · ");
}

function showFlights() {
  const flights = state.flights ?? [];
  byId("none").hidden = flights.length > 0;
  byId("none").textContent = state.error ?? (state.flights ? "No flights yet." : "Not checked yet.");
  byId("flights").replaceChildren(...flights.map((flight) => {
    const item = make("li"), words = make("div"), button = make("button", "Report");
    const parts = [];
    if (flight.started_utc) parts.push(new Date(flight.started_utc).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" }));
    if (flight.duration_s !== null) parts.push(`${(flight.duration_s / 60).toFixed(1)} min`);
    if (flight.applied_l !== null) parts.push(`${withUnit("volume", flight.applied_l)} ordered`);
    parts.push(flight.state === "open" ? "this run, still being recorded" : flight.state);
    words.append(make("b", flight.file), make("span", parts.join(" · "), "small"));
    const mark = markOf(flight);
    if (mark) words.append(make("span", mark, "mark-text small"));
    button.type = "button";
    button.setAttribute("aria-label", `Report of ${flight.file}`);
    button.disabled = Boolean(state.not_now);
    button.addEventListener("click", () => report(flight.file));
    item.append(words, button);
    return item;
  }));
}

function linkTo(told, name, text) {
  const link = make("a", text);
  link.href = `${API}flights/made/${encodeURIComponent(told.flight)}/${encodeURIComponent(name)}`;
  if (name === "report.html") { link.target = "_blank"; link.rel = "noopener"; link.className = "button"; } else link.download = name;
  return link;
}

function leftOf(told) {
  const left = told.left, parts = [make("h3", "What is left")];
  if (told.left_error || !left) return [...parts, make("p", told.left_error ?? "not known", "refused")];
  const where = left.resume ? ` Spraying stopped at ${left.resume.lat.toFixed(6)}, ${left.resume.lon.toFixed(6)}.` : "";
  parts.push(make("p", `${withUnit("area", left.treated_ha)} of ${withUnit("area", left.field_ha)} treated; ${withUnit("area", left.remaining_ha)} and ${withUnit("volume", left.remaining_l)} are left.${where}`));
  for (const text of left.unread ?? []) parts.push(make("p", `not read: ${text}`, "refused"));
  if (!(left.remaining_ha > 0)) return parts;
  parts.push(make("h3", "Continue"));
  if (told.files_of.length === 1 && (facts.parts ?? []).some((one) => one.name === "office")) {
    const row = make("p"), link = make("a", "Plan what is left", "button");
    link.href = `../office/#done=${encodeURIComponent(told.file)}`;
    row.append(link);
    parts.push(row);
  }
  if (told.is_open && facts.spares_treated) parts.push(make("p", "In this run: release STOP, enable, and fly the same mission again. Valves stay closed over ground that is treated."));
  const after = make("p", told.is_open ? "After a restart of the companion: " : "The next time the companion starts: ");
  after.append(make("code", `vrspray run --config ${state.config} ${told.files_of.map((one) => `--continue ${state.journals}/${one}`).join(" ")}`));
  parts.push(after);
  return parts;
}

function together(names, text) {
  const row = make("p"), button = make("button", text);
  button.type = "button";
  button.disabled = Boolean(state.not_now);
  button.addEventListener("click", () => report(names[0], names.slice(1)));
  row.append(button);
  return row;
}

// Only the plan's id makes flights one job; others of the same map are named, and joined when asked.
function jobOf(told) {
  const { sorties, perhaps } = told.job, parts = [];
  if (sorties.length > told.files_of.length) parts.push(make("p", `${told.file} is one of ${sorties.length} sorties of one plan: ${sorties.join(", ")}.`), together(sorties, `Report of the job: ${sorties.length} sorties`));
  const others = perhaps.filter((one) => !told.files_of.includes(one));
  if (others.length) parts.push(make("p", `Flown over the same map within 48 hours, perhaps for the same job, perhaps a second treatment: ${others.join(", ")}.`, "small"), together([...new Set([...told.files_of, ...sorties, ...others])], "They are one job: report them together"));
  return parts;
}

function showReport() {
  const told = state.report;
  byId("report-card").hidden = !told;
  if (!told) return;
  const count = told.files_of.length;
  byId("report-title").textContent = `Report of ${count > 1 ? `a job, ${count} sorties: ${told.files_of.join(", ")}` : told.file}`;
  const parts = told.marks.map((text) => make("p", text, "mark-text"));
  if (told.error) parts.push(make("p", told.error, "refused"));
  if (told.verdict) parts.push(make("p", told.verdict.sentence, "verdict"));
  if (told.is_open) parts.push(make("p", "The run that flew it is still being recorded: this is what it holds so far. End the run for the final report.", "small"));
  const row = make("p");
  if (told.files.includes("report.html")) row.append(linkTo(told, "report.html", "Open the report"));
  for (const name of told.files.filter((one) => one !== "report.html" && !one.startsWith("."))) row.append(linkTo(told, name, name));
  parts.push(row, ...jobOf(told));
  if (told.warnings.length) {
    const list = make("ul");
    list.append(...told.warnings.map((text) => make("li", text, "small")));
    parts.push(list);
  }
  byId("report").replaceChildren(...parts, ...leftOf(told));
}

function show() {
  const box = byId("not-now");
  box.hidden = !state.not_now;
  box.textContent = state.not_now ? `Not now: ${state.not_now}.` : "";
  byId("look").disabled = Boolean(state.not_now);
  showFlights(); showReport();
}

begin();

byId("look").addEventListener("click", () => doing("Looking", () => ask("flights/look", {})));

state = await ask("flights").catch((error) => { say(error.message, true); return state; });
facts = await ask("facts").catch(() => ({}));
show();
const wanted = new URLSearchParams(location.hash.slice(1)).get("report");
if (!state.not_now) await doing("Looking", () => ask("flights/look", {}));
if (wanted && !state.not_now) await report(wanted);
document.body.dataset.flights = "ready";
setInterval(async () => { // the vehicle may be armed meanwhile
  if (document.body.dataset.busy || document.hidden) return;
  const next = await ask("flights").catch(() => null);
  if (next && next.not_now !== state.not_now) { state = next; show(); }
}, 2000);
