// The office's map by WebGL: zones, boundary, planned lines, and the corners that are being drawn.

import { Scale } from "../static/geo.js";

const LOOK = {
  day: { ground: "#e2e6df", field: "#10150f", passes: ["#0a4f8f", "#a3125f", "#5b3a00", "#6b21a8"], ferry: "#b45309", draw: "#c4060c" },
  night: { ground: "#0b1114", field: "#e9efe9", passes: ["#7dd3fc", "#ff9ad5", "#c5f277", "#c4a2ff"], ferry: "#ffb04d", draw: "#ff7b7b" },
};
const NOTHING = { type: "FeatureCollection", features: [] };

export class OfficeMap {
  constructor(element, theme, { onClick, onMove }) {
    this.look = LOOK[theme];
    this.theme = theme;
    this.element = element;
    this.draws = false;
    this.works = false;
    this.shown = {};
    this.fitting = 0;
    this.ready = this.make(onClick, onMove).then(() => { this.works = true; }, (error) => console.warn("no map:", error.message ?? error));
  }

  async make(onClick, onMove) {
    if (!document.createElement("canvas").getContext("webgl2")) throw new Error("no WebGL 2");
    const maplibre = await import("../static/vendor/maplibre-gl/maplibre-gl.mjs");
    const look = this.look;
    const map = new maplibre.Map({
      container: this.element, center: [0, 0], zoom: 1, attributionControl: false, dragRotate: false, pitchWithRotate: false, touchPitch: false, maxZoom: 23, fadeDuration: 0, doubleClickZoom: false,
      style: { version: 8, sources: {}, layers: [{ id: "ground", type: "background", paint: { "background-color": look.ground } }] },
    });
    map.addControl(new maplibre.ScaleControl({ unit: "metric" }), "bottom-left");
    await new Promise((resolve, reject) => { map.once("load", resolve); map.once("error", (found) => reject(found.error)); });
    for (const name of ["zones", "field", "lines", "draw"]) map.addSource(name, { type: "geojson", data: NOTHING });
    map.addLayer({ id: "zones", type: "fill", source: "zones", paint: { "fill-opacity": 0.75 } });
    map.addLayer({ id: "field", type: "line", source: "field", paint: { "line-color": look.field, "line-width": 2.5 } });
    map.addLayer({ id: "lines", type: "line", source: "lines", paint: { "line-color": ["match", ["get", "kind"], ["spray", "spray-part"], ["match", ["%", ["get", "sortie"], 4], ...look.passes.slice(0, 3).flatMap((color, k) => [k + 1, color]), look.passes[3]], look.ferry], "line-width": ["match", ["get", "kind"], ["spray", "spray-part"], 2.5, 1.5] } });
    map.addLayer({ id: "draw", type: "line", source: "draw", paint: { "line-color": look.draw, "line-width": 3, "line-dasharray": [2, 1] } });
    map.addLayer({ id: "corners", type: "circle", source: "draw", filter: ["==", ["geometry-type"], "Point"], paint: { "circle-radius": 9, "circle-color": look.draw, "circle-stroke-color": look.ground, "circle-stroke-width": 2 } });
    // For tests: `data-settled` is there once the map shows what it was given last.
    map.on("idle", () => { if (!this.fitting) this.element.dataset.settled = ""; });
    this.map = map;
    this.pointers(onClick, onMove);
  }

  pointers(onClick, onMove) {
    const map = this.map;
    let moved = null;
    const place = (event) => [event.lngLat.lng, event.lngLat.lat];
    const begin = (event) => { event.preventDefault(); moved = event.features[0].properties.index; };
    for (const name of ["mousedown", "touchstart"]) map.on(name, "corners", begin);
    for (const name of ["mousemove", "touchmove"]) map.on(name, (event) => { if (moved !== null) onMove(moved, place(event)); });
    for (const name of ["mouseup", "touchend"]) map.on(name, () => { setTimeout(() => { moved = null; }, 0); });
    map.on("click", (event) => {
      if (!this.draws || moved !== null || map.queryRenderedFeatures(event.point, { layers: ["corners"] }).length) return;
      onClick(place(event));
    });
  }

  colorOf(sortie) { return this.look.passes[(sortie + 3) % 4]; }

  // Each is an address of the office; read in the map's worker, and only when it is another.
  showFiles({ zones, field, lines, rates }) {
    if (!this.works) return;
    const key = JSON.stringify([zones, field, lines, rates]);
    if (key === this.shown.key && !lines && !zones) return;
    this.shown.key = key;
    delete this.element.dataset.settled;
    this.map.getSource("zones").setData(zones ?? NOTHING);
    this.map.getSource("field").setData(field ?? NOTHING);
    this.map.getSource("lines").setData(lines ?? NOTHING);
    this.map.setPaintProperty("zones", "fill-color", new Scale(rates, this.theme).fill(["to-number", ["get", "rate"]]));
    this.fit();
  }

  async fit() {
    this.fitting += 1;
    const bounds = await Promise.all(["field", "zones", "lines"].map((name) => this.map.getSource(name).getBounds().catch(() => null)));
    const found = bounds.find((one) => one && !one.isEmpty());
    if (found) this.map.fitBounds(found, { padding: 40, duration: 0, maxZoom: 20 });
    this.fitting -= 1;
    this.map.triggerRepaint();
  }

  showCorners(corners) {
    if (!this.works) return;
    const points = corners.map((one, index) => ({ type: "Feature", properties: { index }, geometry: { type: "Point", coordinates: one } }));
    const line = corners.length > 1 ? [{ type: "Feature", properties: {}, geometry: { type: "LineString", coordinates: [...corners, corners[0]] } }] : [];
    delete this.element.dataset.settled;
    this.map.getSource("draw").setData({ type: "FeatureCollection", features: [...line, ...points] });
  }
}
