// The map on a plain canvas: for browsers without WebGL 2. The same calls as map-gl.js.

import { ZoneIndex, boomLines, margins, strips } from "./geo.js";

const LOOK = {
  day: { ground: "#e2e6df", field: "#10150f", zone: "#3d4a42", ahead: "#c2410c", closed: "#10150f", open: "#0ea5e9", halo: "#ffffff", craft: "#10150f" },
  night: { ground: "#0b1114", field: "#e9efe9", zone: "#6b7a80", ahead: "#ffb04d", closed: "#aab6b0", open: "#7dd3fc", halo: "#05080a", craft: "#ffffff" },
};

const AGAIN = 10; // points whose error what came later may make smaller

export async function create(element, ground, scale, theme, onView) {
  const response = await fetch("api/v1/zones", { credentials: "same-origin" });
  const zones = await response.json();
  const index = new ZoneIndex(zones);
  const canvas = document.createElement("canvas");
  canvas.className = "plain";
  element.append(canvas);
  const pen = canvas.getContext("2d");
  const back = document.createElement("canvas"); // zones and treated ground, in this view
  const under = back.getContext("2d");
  let look = LOOK[theme], colors = scale, points = [], drawn = 0;
  let vehicle = null, duty = [], ahead = -1, follows = false;
  const view = { east: 0, north: 0, perMeter: 1, ratio: 1 };

  const x = (east) => (east - view.east) * view.perMeter + back.width / 2;
  const y = (north) => back.height / 2 - (north - view.north) * view.perMeter;

  function path(on, areas) {
    on.beginPath();
    for (const area of areas) for (const ring of area) {
      for (let i = 0; i < ring.length; i += 2) {
        if (i === 0) on.moveTo(x(ring[0]), y(ring[1])); else on.lineTo(x(ring[i]), y(ring[i + 1]));
      }
      on.closePath();
    }
  }

  function treated(from) {
    under.lineWidth = view.ratio; // over the seam that two fills side by side leave
    for (let i = Math.max(from, 1); i < points.length; i += 1) {
      for (const strip of strips(ground.boom.valves, points[i - 1], points[i])) {
        under.fillStyle = under.strokeStyle = colors.treated(points, i - 1);
        under.beginPath();
        strip.ring.forEach(([e, n], k) => (k ? under.lineTo(x(e), y(n)) : under.moveTo(x(e), y(n))));
        under.closePath();
        under.fill();
        under.stroke();
      }
    }
    drawn = points.length;
  }

  function redraw() {
    under.fillStyle = look.ground;
    under.fillRect(0, 0, back.width, back.height);
    under.lineWidth = view.ratio;
    for (const zone of zones) {
      path(under, zone.areas);
      under.globalAlpha = 0.3;
      under.fillStyle = colors.color(zone.rate_l_ha);
      under.fill("evenodd");
      under.globalAlpha = 0.7;
      under.strokeStyle = look.zone;
      if (zones.length <= 3000) under.stroke();
    }
    under.globalAlpha = 1;
    treated(1);
    under.lineWidth = 2.5 * view.ratio;
    under.strokeStyle = look.field;
    path(under, ground.field);
    under.stroke();
    paint();
    onView(view.ratio / view.perMeter);
  }

  function paint() {
    pen.drawImage(back, 0, 0);
    if (ahead >= 0) {
      path(pen, zones[ahead].areas);
      pen.lineWidth = 3 * view.ratio; pen.strokeStyle = look.ahead; pen.stroke();
    }
    if (!vehicle || vehicle.east_m === null) return;
    const [cx, cy, r] = [x(vehicle.east_m), y(vehicle.north_m), view.ratio];
    if (vehicle.speed_m_s >= 0.5) {
      const [ax, ay] = [x(vehicle.ahead_east_m), y(vehicle.ahead_north_m)];
      pen.strokeStyle = pen.fillStyle = look.ahead; pen.lineWidth = 2 * r; pen.setLineDash([5 * r, 5 * r]);
      pen.beginPath(); pen.moveTo(cx, cy); pen.lineTo(ax, ay); pen.stroke(); pen.setLineDash([]);
      pen.beginPath(); pen.arc(ax, ay, 6 * r, 0, 7); pen.fill();
      pen.strokeStyle = look.halo; pen.stroke();
    }
    for (const width of [9, 5]) for (const { isOpen, ends } of boomLines(ground.boom.valves, vehicle, duty)) {
      pen.lineWidth = width * r; pen.strokeStyle = width === 9 ? look.halo : isOpen ? look.open : look.closed;
      pen.beginPath(); pen.moveTo(x(ends[0][0]), y(ends[0][1])); pen.lineTo(x(ends[1][0]), y(ends[1][1])); pen.stroke();
    }
    pen.save(); pen.translate(cx, cy); pen.rotate(((vehicle.heading_deg ?? 0) * Math.PI) / 180); pen.scale(r, r);
    pen.beginPath(); pen.moveTo(0, -13); pen.lineTo(8.5, 10); pen.lineTo(0, 5.5); pen.lineTo(-8.5, 10); pen.closePath();
    pen.lineWidth = 4; pen.lineJoin = "round"; pen.strokeStyle = look.halo; pen.stroke(); pen.fillStyle = look.craft; pen.fill();
    pen.restore();
  }

  function fit() {
    const [west, south, east, north] = ground.bounds_m;
    const { left, right, top, bottom } = margins(element), r = view.ratio;
    view.perMeter = Math.max(Math.min((back.width - (left + right) * r) / Math.max(east - west, 1), (back.height - (top + bottom) * r) / Math.max(north - south, 1)), 0.001);
    view.east = (west + east) / 2 - (left - right) * r / 2 / view.perMeter; view.north = (south + north) / 2 + (top - bottom) * r / 2 / view.perMeter;
    redraw();
  }

  function zoomBy(factor, px = back.width / 2, py = back.height / 2) {
    const east = view.east + (px - back.width / 2) / view.perMeter, north = view.north - (py - back.height / 2) / view.perMeter;
    view.perMeter = Math.min(Math.max(view.perMeter * factor, 0.005), 400);
    view.east = east - (px - back.width / 2) / view.perMeter; view.north = north + (py - back.height / 2) / view.perMeter;
    redraw();
  }

  let isFirst = true;
  new ResizeObserver(() => {
    view.ratio = Math.min(window.devicePixelRatio || 1, 2);
    for (const one of [canvas, back]) { one.width = Math.max(element.clientWidth * view.ratio, 1); one.height = Math.max(element.clientHeight * view.ratio, 1); }
    if (isFirst) { isFirst = false; fit(); } else redraw();
  }).observe(element);

  const fingers = new Map();
  let planned = false;
  const soon = () => { if (!planned) { planned = true; requestAnimationFrame(() => { planned = false; redraw(); }); } };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, [event.clientX, event.clientY]); });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    if (others.length) {
      const apart = (place) => Math.hypot(place[0] - others[0][0], place[1] - others[0][1]) || 1;
      view.perMeter *= apart([event.clientX, event.clientY]) / apart(last);
    } else {
      follows = false; onView(null, false);
      view.east -= ((event.clientX - last[0]) * view.ratio) / view.perMeter;
      view.north += ((event.clientY - last[1]) * view.ratio) / view.perMeter;
    }
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    soon();
  });
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoomBy(2 ** (-event.deltaY / 300), event.offsetX * view.ratio, event.offsetY * view.ratio); }, { passive: false });

  return {
    kind: "canvas",
    setWay(all) { points = all; redraw(); },
    addPoints(all) { points = all; treated(drawn - (colors.byError ? AGAIN : 0)); paint(); },
    setVehicle(next, nextDuty) {
      vehicle = next; duty = nextDuty;
      ahead = next.ahead_east_m === null || !next.in_air ? -1 : index.at(next.ahead_east_m, next.ahead_north_m);
      if (follows && vehicle.east_m !== null) { view.east = vehicle.east_m; view.north = vehicle.north_m; redraw(); } else paint();
    },
    setTheme(name, next) { look = LOOK[name]; colors = next; redraw(); },
    follow(yes) { follows = yes; },
    fit() { follows = false; fit(); },
    zoom(step) { zoomBy(2 ** step); },
  };
}
