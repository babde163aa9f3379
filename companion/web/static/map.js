// The map: by WebGL where the browser has it, on a plain canvas elsewhere. The rest works without.

import { Scale } from "./geo.js";
import { unitOf, value } from "./units.js";

const LEGEND_MAX = 7;

function hasWebGl() {
  try {
    return Boolean(document.createElement("canvas").getContext("webgl2"));
  } catch {
    return false;
  }
}

export class FieldMap {
  constructor() {
    this.element = document.getElementById("map");
    this.back = null;
    this.points = [];
    this.vehicle = null;
    this.theme = "day";
    this.byError = false;
  }

  async load(ground, theme) {
    this.ground = ground;
    this.theme = theme;
    this.rates = [...ground.rates_l_ha];
    if (ground.default_rate_l_ha) this.rates.push(ground.default_rate_l_ha);
    this.colors();
    const onView = (metersPerPixel, follows) => this.viewed(metersPerPixel, follows);
    const wantsPlain = new URLSearchParams(location.search).has("plain");
    if (!wantsPlain && hasWebGl()) {
      try {
        const { create } = await import("./map-gl.js");
        this.back = await create(this.element, ground, this.scale, theme, onView);
      } catch (error) {
        console.warn("map without WebGL:", error);
        this.element.replaceChildren();
      }
    }
    if (!this.back) {
      const { create } = await import("./map-plain.js");
      this.back = await create(this.element, ground, this.scale, theme, onView);
    }
    this.element.dataset.kind = this.back.kind;
    if (this.theme !== theme) this.setTheme(this.theme);
    this.back.setWay(this.points);
    this.buttons();
  }

  buttons() {
    const follow = document.getElementById("map-follow");
    follow.addEventListener("click", () => {
      const yes = follow.getAttribute("aria-pressed") !== "true";
      follow.setAttribute("aria-pressed", String(yes));
      this.back.follow(yes);
    });
    const error = document.getElementById("map-error");
    error.addEventListener("click", () => {
      this.byError = !this.byError;
      error.setAttribute("aria-pressed", String(this.byError));
      this.setTheme(this.theme);
    });
    document.getElementById("map-fit").addEventListener("click", () => { follow.setAttribute("aria-pressed", "false"); this.back.fit(); });
    document.getElementById("map-in").addEventListener("click", () => this.back.zoom(1));
    document.getElementById("map-out").addEventListener("click", () => this.back.zoom(-1));
  }

  viewed(metersPerPixel, follows) {
    if (follows === false) document.getElementById("map-follow").setAttribute("aria-pressed", "false");
    if (metersPerPixel) { this.metersPerPixel = metersPerPixel; this.scaleBar(); }
  }

  scaleBar() {
    if (!this.metersPerPixel) return;
    const isUs = unitOf("length") === "ft";
    const perPixel = this.metersPerPixel * (isUs ? 3.28084 : 1);
    const most = 110 * perPixel;
    const base = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((k) => k * base).find((one) => one <= most);
    const bar = document.getElementById("scale");
    bar.style.width = `${Math.round(length / perPixel)}px`;
    bar.firstElementChild.textContent = `${length >= 1 ? length : length.toFixed(1)} ${unitOf("length")}`;
  }

  legend() {
    const box = document.getElementById("legend");
    const rows = this.rates.length <= LEGEND_MAX ? this.rates
      : Array.from({ length: 5 }, (_, k) => this.rates[Math.round((k * (this.rates.length - 1)) / 4)]);
    const title = document.createElement("b");
    title.textContent = unitOf("rate");
    box.replaceChildren(title, ...rows.map((rate) => {
      const row = document.createElement("div");
      const swatch = document.createElement("canvas");
      swatch.width = 26; swatch.height = 13;
      const pen = swatch.getContext("2d");
      pen.fillStyle = this.scale.color(rate);
      pen.globalAlpha = 0.3; pen.fillRect(0, 0, 13, 13);
      pen.globalAlpha = 0.92; pen.fillRect(13, 0, 13, 13);
      row.append(swatch, value("rate", rate));
      return row;
    }));
    const note = document.createElement("b");
    note.textContent = this.byError ? "map" : "map · done";
    box.append(note);
    if (this.byError) this.errorLegend(box);
    this.scaleBar();
  }

  errorLegend(box) {
    const title = document.createElement("b");
    title.textContent = "% off";
    box.append(title, ...this.scale.errors().map(([color, words]) => {
      const row = document.createElement("div"), swatch = document.createElement("canvas");
      swatch.width = 26; swatch.height = 13;
      const pen = swatch.getContext("2d");
      pen.fillStyle = color; pen.fillRect(0, 0, 26, 13);
      row.append(swatch, words);
      return row;
    }));
  }

  setWay(points) { this.points = points; this.back?.setWay(points); }

  addPoints(points, from) { this.points = points; this.back?.addPoints(points, from); }

  setVehicle(vehicle, duty) {
    if (!this.back || !vehicle) return;
    this.back.setVehicle(vehicle, duty);
  }

  setTheme(theme) {
    this.theme = theme;
    if (!this.back) return;
    this.colors();
    this.back.setTheme(theme, this.scale);
  }

  colors() {
    this.scale = new Scale(this.rates, this.theme, { aheadS: this.ground.ahead_s, byError: this.byError });
    this.legend();
  }
}
