// The map by WebGL (MapLibre GL). Loaded only where WebGL 2 is there; see map.js.

import * as maplibre from "./vendor/maplibre-gl/maplibre-gl.mjs";
import { Frame, boomLines, margins, pairs, strips } from "./geo.js";

const CHUNK = 300; // points of the treated way in one source: only the last one changes
const LOOK = {
  day: { ground: "#e2e6df", field: "#10150f", zone: "#3d4a42", ahead: "#c2410c", closed: "#10150f", open: "#0ea5e9", halo: "#ffffff", craft: "#10150f" },
  night: { ground: "#0b1114", field: "#e9efe9", zone: "#6b7a80", ahead: "#ffb04d", closed: "#aab6b0", open: "#7dd3fc", halo: "#05080a", craft: "#ffffff" },
};

function collection(features = []) {
  return { type: "FeatureCollection", features };
}

function craftImage(color, halo) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const pen = canvas.getContext("2d", { willReadFrequently: true });
  pen.translate(32, 32);
  pen.beginPath();
  pen.moveTo(0, -26); pen.lineTo(17, 20); pen.lineTo(0, 11); pen.lineTo(-17, 20); pen.closePath();
  pen.lineWidth = 8; pen.lineJoin = "round"; pen.strokeStyle = halo; pen.stroke();
  pen.fillStyle = color; pen.fill();
  return pen.getImageData(0, 0, 64, 64);
}

// Its own style sheet, before the map is made: the page does not wait for it.
function styled() {
  return new Promise((resolve) => {
    const sheet = document.createElement("link");
    sheet.rel = "stylesheet";
    sheet.href = new URL("./vendor/maplibre-gl/maplibre-gl.css", import.meta.url).href;
    sheet.onload = sheet.onerror = resolve;
    document.head.append(sheet);
  });
}

export async function create(element, ground, scale, theme, onView) {
  await styled();
  const frame = new Frame(ground.origin);
  const ring = (points) => { const found = points.map(([e, n]) => frame.lngLat(e, n)); found.push(found[0]); return found; };
  const [west, south, east, north] = ground.bounds_m;
  const bounds = [frame.lngLat(west, south), frame.lngLat(east, north)];
  const map = new maplibre.Map({
    container: element, bounds, fitBoundsOptions: { padding: margins(element) }, attributionControl: false,
    dragRotate: false, pitchWithRotate: false, touchPitch: false, maxZoom: 23, fadeDuration: 0,
    style: { version: 8, sources: {}, layers: [{ id: "ground", type: "background", paint: { "background-color": LOOK[theme].ground } }] },
  });
  map.touchZoomRotate.disableRotation();
  map.keyboard.disableRotation();
  await new Promise((resolve, reject) => { map.once("load", resolve); map.once("error", (found) => reject(found.error)); });

  const chunks = [];
  let points = [], zone = -1;
  let colors = scale;
  // The zones are read, cut and coloured in the worker: a map of 40,000 does not hold up this thread.
  const zoneColor = () => colors.fill(["get", "rate"]);
  const treatedFeatures = (from, to) => {
    const found = [];
    for (let i = Math.max(from, 1); i < to; i += 1) {
      const color = colors.treated(points, i - 1);
      for (const strip of strips(ground.boom.valves, points[i - 1], points[i])) {
        found.push({ type: "Feature", properties: { color }, geometry: { type: "Polygon", coordinates: [ring(strip.ring)] } });
      }
    }
    return found;
  };

  // In parts: what the worker has read is given to this thread in one go each.
  const parts = Array.from({ length: ground.zone_parts }, (_, k) => k);
  const zoneLayers = parts.map((k) => `zones-${k}`);
  for (const k of parts) map.addSource(`zones-${k}`, { type: "geojson", data: new URL(`api/v1/zones.geojson?part=${k}`, document.baseURI).href, tolerance: 0.1, buffer: 8 });
  map.addSource("field", { type: "geojson", data: collection(ground.field.map((area) => ({ type: "Feature", properties: {}, geometry: { type: "Polygon", coordinates: area.map((one) => pairs(one).map(([e, n]) => frame.lngLat(e, n))) } }))) });
  for (const name of ["boom", "ahead", "craft"]) map.addSource(name, { type: "geojson", data: collection() });
  for (const id of zoneLayers) map.addLayer({ id, type: "fill", source: id, paint: { "fill-color": zoneColor(), "fill-opacity": 0.3, "fill-antialias": false } });
  if (ground.zone_count <= 3000) map.addLayer({ id: "zone-lines", type: "line", source: "zones-0", paint: { "line-color": LOOK[theme].zone, "line-width": 1, "line-opacity": 0.7 } });
  for (const k of parts) map.addLayer({ id: `zone-ahead-${k}`, type: "line", source: `zones-${k}`, filter: ["==", ["get", "zone"], -1], paint: { "line-color": LOOK[theme].ahead, "line-width": 3 } });
  map.addLayer({ id: "field", type: "line", source: "field", paint: { "line-color": LOOK[theme].field, "line-width": 2.5 } });
  map.addLayer({ id: "ahead-line", type: "line", source: "ahead", paint: { "line-color": LOOK[theme].ahead, "line-width": 2, "line-dasharray": [2, 2] } });
  map.addLayer({ id: "ahead", type: "circle", source: "ahead", filter: ["==", ["geometry-type"], "Point"], paint: { "circle-radius": 6, "circle-color": LOOK[theme].ahead, "circle-stroke-width": 2, "circle-stroke-color": LOOK[theme].halo } });
  map.addLayer({ id: "boom-halo", type: "line", source: "boom", paint: { "line-color": LOOK[theme].halo, "line-width": 9 } });
  map.addLayer({ id: "boom", type: "line", source: "boom", paint: { "line-color": ["case", ["get", "isOpen"], LOOK[theme].open, LOOK[theme].closed], "line-width": 5 } });
  map.addImage("craft", craftImage(LOOK[theme].craft, LOOK[theme].halo), { pixelRatio: 2 });
  map.addLayer({ id: "craft", type: "symbol", source: "craft", layout: { "icon-image": "craft", "icon-rotate": ["get", "heading"], "icon-rotation-alignment": "map", "icon-allow-overlap": true, "icon-ignore-placement": true } });

  let follows = false;
  const tellView = () => {
    const center = map.getCenter();
    const meters = (156543.03392 / 2) * Math.cos((center.lat * Math.PI) / 180) / 2 ** map.getZoom();
    onView(meters);
  };
  map.on("move", tellView);
  map.on("dragstart", () => { follows = false; onView(null, false); });
  tellView();

  function draw(from) {
    for (let number = Math.floor(Math.max(from - 1, 0) / CHUNK); number * CHUNK < points.length; number += 1) {
      const data = collection(treatedFeatures(number * CHUNK, Math.min((number + 1) * CHUNK, points.length)));
      if (chunks[number]) map.getSource(`treated-${number}`).setData(data);
      else {
        map.addSource(`treated-${number}`, { type: "geojson", data, tolerance: 0, buffer: 0 });
        map.addLayer({ id: `treated-${number}`, type: "fill", source: `treated-${number}`, paint: { "fill-color": ["get", "color"], "fill-opacity": 0.92, "fill-antialias": false } }, "zone-ahead-0");
        chunks[number] = true;
      }
    }
  }

  return {
    kind: "webgl",
    setWay(all) {
      points = all;
      chunks.forEach((_, number) => map.getSource(`treated-${number}`).setData(collection()));
      draw(0);
    },
    addPoints(all, from) { points = all; draw(from); },
    setVehicle(vehicle, duty) {
      if (vehicle.east_m === null || vehicle.north_m === null) return;
      const here = frame.lngLat(vehicle.east_m, vehicle.north_m);
      const line = (ends) => ({ type: "LineString", coordinates: ends.map(([e, n]) => frame.lngLat(e, n)) });
      map.getSource("craft").setData({ type: "Feature", properties: { heading: vehicle.heading_deg ?? 0 }, geometry: { type: "Point", coordinates: here } });
      map.getSource("boom").setData(collection(boomLines(ground.boom.valves, vehicle, duty).map((one) => ({ type: "Feature", properties: { isOpen: one.isOpen }, geometry: line(one.ends) }))));
      const ahead = [vehicle.ahead_east_m, vehicle.ahead_north_m];
      map.getSource("ahead").setData(ahead[0] === null || vehicle.speed_m_s < 0.5 ? collection() : collection([
        { type: "Feature", properties: {}, geometry: line([[vehicle.east_m, vehicle.north_m], ahead]) },
        { type: "Feature", properties: {}, geometry: { type: "Point", coordinates: frame.lngLat(...ahead) } },
      ]));
      const found = ahead[0] === null || !vehicle.in_air ? [] : map.queryRenderedFeatures(map.project(frame.lngLat(...ahead)), { layers: zoneLayers });
      const next = found[0]?.properties.zone ?? -1;
      if (next !== zone) { zone = next; for (const k of parts) map.setFilter(`zone-ahead-${k}`, ["==", ["get", "zone"], zone]); }
      if (follows) map.easeTo({ center: here, duration: 180, easing: (t) => t });
    },
    setTheme(name, next) {
      colors = next;
      const look = LOOK[name];
      map.setPaintProperty("ground", "background-color", look.ground);
      if (map.getLayer("zone-lines")) map.setPaintProperty("zone-lines", "line-color", look.zone);
      for (const id of [...parts.map((k) => `zone-ahead-${k}`), "ahead-line"]) map.setPaintProperty(id, "line-color", look.ahead);
      map.setPaintProperty("field", "line-color", look.field);
      map.setPaintProperty("ahead", "circle-color", look.ahead);
      map.setPaintProperty("ahead", "circle-stroke-color", look.halo);
      map.setPaintProperty("boom-halo", "line-color", look.halo);
      map.setPaintProperty("boom", "line-color", ["case", ["get", "isOpen"], look.open, look.closed]);
      map.updateImage("craft", craftImage(look.craft, look.halo));
      for (const id of zoneLayers) map.setPaintProperty(id, "fill-color", zoneColor());
      draw(0);
    },
    follow(yes) { follows = yes; },
    fit() { follows = false; map.fitBounds(bounds, { padding: margins(element), duration: 200 }); },
    zoom(step) { map.zoomTo(map.getZoom() + step, { duration: 150 }); },
  };
}
