// How all parts of the page ask the companion.

// Relative to this file: a part of the page below it asks the same as the page itself.
export const API = new URL("../api/v1/", import.meta.url).href;

export async function ask(place, body, { kind = "application/json", withinMs } = {}) {
  const options = body === undefined ? {} : { method: "POST", headers: { "Content-Type": kind }, body: kind === "application/json" ? JSON.stringify(body) : body };
  if (withinMs) options.signal = AbortSignal.timeout(withinMs);
  const response = await fetch(`${API}${place}`, { credentials: "same-origin", ...options });
  const answer = await response.json().catch(() => null);
  if (!response.ok) throw new Error(typeof answer?.detail === "string" ? answer.detail : `refused (${response.status})`);
  if (answer === null) throw new Error("the answer broke off"); // as a run that starts again leaves it
  return answer;
}
