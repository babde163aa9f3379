// Orders: STOP at the first touch; what opens valves only after a press of a second.

import { ask } from "./api.js";

const ANSWER_MS = 2500;
const STOP_TRIES = 6;

const post = (name, body = {}) => ask(name, body, { withinMs: ANSWER_MS });

export function stopping(button, say) {
  let touched = -Infinity; // a key in the first second counts, too
  const stop = async () => {
    for (let k = 0; k < STOP_TRIES; k += 1) {
      try {
        const answer = await post("stop");
        if (answer.accepted) { say(answer.text); return; }
      } catch { /* tried again */ }
      say("STOP NOT CONFIRMED: use the transmitter's switch!", true);
      await new Promise((resolve) => setTimeout(resolve, 300));
    }
  };
  // At the touch itself, not when the finger is lifted; a click remains for the keyboard.
  button.addEventListener("pointerdown", (event) => { if (event.button === 0) { touched = performance.now(); stop(); } });
  button.addEventListener("click", () => { if (performance.now() - touched > 1000) stop(); });
}

export class Orders {
  constructor(say) {
    this.say = say;
    this.releases = false;
    this.stopButton = document.getElementById("stop");
    this.enableButton = document.getElementById("enable");
    this.disableButton = document.getElementById("disable");
    this.refill = document.getElementById("refill");
    stopping(this.stopButton, say);
    this.holds();
    this.disableButton.addEventListener("click", () => this.give("disable"));
  }

  async give(name, body) {
    try {
      const answer = await post(name, body);
      this.say(answer.text, !answer.accepted);
      return answer.accepted;
    } catch (error) {
      this.say(error.name === "TimeoutError" ? "No answer from the companion." : error.message, true);
      return false;
    }
  }

  holds() {
    const button = this.enableButton;
    let press = 0;
    const begin = async (event) => {
      event.preventDefault();
      if (button.disabled) return;
      const mine = (press += 1);
      button.classList.add("pressed");
      try {
        const { ticket, hold_s: holdS } = await post("hold");
        await new Promise((resolve) => setTimeout(resolve, holdS * 1000 + 60));
        if (mine !== press || !button.classList.contains("pressed")) return;
        await (this.releases ? this.give("disable") : this.give("enable", { ticket }));
      } catch (error) {
        this.say(error.message, true);
      }
      end();
    };
    const end = () => { press += 1; button.classList.remove("pressed"); };
    const short = () => { if (button.classList.contains("pressed")) { end(); this.say("Keep the button pressed for a second."); } };
    button.addEventListener("pointerdown", (event) => { if (event.button === 0) begin(event); });
    for (const name of ["pointerup", "pointerleave", "pointercancel", "blur"]) button.addEventListener(name, short);
    button.addEventListener("contextmenu", (event) => event.preventDefault());
    button.addEventListener("keydown", (event) => { if ((event.key === " " || event.key === "Enter") && !event.repeat) begin(event); });
    button.addEventListener("keyup", (event) => { if (event.key === " " || event.key === "Enter") { event.preventDefault(); short(); } });
  }

  show(state, facts, scope) {
    const mayOperate = scope === "operate";
    const latched = state.state === "estop" || state.state === "fault";
    const enabled = Boolean(state.vehicle?.enabled);
    this.releases = latched;
    this.enableButton.classList.toggle("release", latched);
    this.enableButton.classList.toggle("given", enabled && !latched);
    const label = latched ? (state.state === "estop" ? "Hold to release STOP" : "Hold to release the fault") : enabled ? "Enabled" : "Hold to enable";
    const text = this.enableButton.firstElementChild;
    if (text.textContent !== label) text.textContent = label;
    this.enableButton.disabled = !mayOperate || (!latched && (enabled || !facts.may_enable));
    this.disableButton.disabled = !mayOperate || !enabled;
    for (const item of this.refill.elements) item.disabled = !mayOperate;
    const ways = { command: "the ground station", rc: "the RC switch", web: "this page" };
    document.getElementById("orders-note").textContent = !mayOperate
      ? "You may look and stop. Enabling needs the operator's link."
      : facts.may_enable ? "" : `Spraying is enabled by ${(facts.enable_by ?? []).map((way) => ways[way]).join(" or ")} (safety.enable_by).`;
  }
}

export async function logIn() {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (token) {
    history.replaceState(null, "", location.pathname + location.search);
    try {
      return await post("session", { token });
    } catch (error) {
      console.warn(error.message);
    }
  }
  return ask("session");
}
