// Geometry and colours that both maps share. Places are metres east and north of the origin.

const A_M = 6378137.0;
const E2 = 0.00669437999014;

export class Frame {
  constructor(origin) {
    const sin = Math.sin((origin.latitude_deg * Math.PI) / 180);
    const cos = Math.cos((origin.latitude_deg * Math.PI) / 180);
    const w = Math.sqrt(1 - E2 * sin * sin);
    this.origin = origin;
    this.perLat = ((Math.PI / 180) * A_M * (1 - E2)) / (w * w * w);
    this.perLon = ((Math.PI / 180) * A_M * cos) / w;
  }

  lngLat(east, north) {
    return [
      this.origin.longitude_deg + east / this.perLon,
      this.origin.latitude_deg + north / this.perLat,
    ];
  }
}

// A ring as it comes (east, north, east, ...) as pairs.
export function pairs(ring) {
  const found = [];
  for (let i = 0; i + 1 < ring.length; i += 2) found.push([ring[i], ring[i + 1]]);
  return found;
}

function isInside(ring, east, north) {
  let inside = false;
  for (let i = 0, j = ring.length - 2; i < ring.length; j = i, i += 2) {
    const north1 = ring[i + 1], north2 = ring[j + 1];
    if (north1 > north !== north2 > north) {
      const at = ring[i] + ((north - north1) / (north2 - north1)) * (ring[j] - ring[i]);
      if (east < at) inside = !inside;
    }
  }
  return inside;
}

// Which zone a place lies in; boxes first, so that 40,000 zones cost little.
export class ZoneIndex {
  constructor(zones) {
    this.zones = zones;
    this.boxes = new Float64Array(zones.length * 4);
    zones.forEach((zone, index) => {
      let [west, south, east, north] = [Infinity, Infinity, -Infinity, -Infinity];
      for (const area of zone.areas) {
        const ring = area[0];
        for (let i = 0; i < ring.length; i += 2) {
          west = Math.min(west, ring[i]); east = Math.max(east, ring[i]);
          south = Math.min(south, ring[i + 1]); north = Math.max(north, ring[i + 1]);
        }
      }
      this.boxes.set([west, south, east, north], index * 4);
    });
  }

  at(east, north) {
    const boxes = this.boxes;
    for (let k = 0, index = 0; k < boxes.length; k += 4, index += 1) {
      if (east < boxes[k] || east > boxes[k + 2] || north < boxes[k + 1] || north > boxes[k + 3]) continue;
      for (const area of this.zones[index].areas) {
        if (isInside(area[0], east, north) && !area.slice(1).some((hole) => isInside(hole, east, north))) return index;
      }
    }
    return -1;
  }
}

function tip(point, right, forward) {
  const heading = (point[3] * Math.PI) / 180;
  const sin = Math.sin(heading), cos = Math.cos(heading);
  return [point[1] + sin * forward + cos * right, point[2] + cos * forward - sin * right];
}

// What the boom treated between two points: quadrilaterals, neighbours joined.
export function strips(valves, before, after) {
  const found = [];
  const gone = Math.hypot(after[1] - before[1], after[2] - before[2]);
  const time = after[0] - before[0];
  if (gone > 30 || time < 0 || time > 1.5 + gone) return found;
  for (let first = 0; first < valves.length; first += 1) {
    if (before[4][first] !== "1") continue;
    let last = first;
    while (
      last + 1 < valves.length && before[4][last + 1] === "1" &&
      Math.abs(valves[last + 1].right_m - valves[last + 1].width_m / 2 - valves[last].right_m - valves[last].width_m / 2) < 0.05 &&
      Math.abs(valves[last + 1].forward_m - valves[last].forward_m) < 0.05
    ) last += 1;
    const left = valves[first].right_m - valves[first].width_m / 2;
    const right = valves[last].right_m + valves[last].width_m / 2;
    const forward = valves[first].forward_m;
    found.push({
      ring: [tip(before, left, forward), tip(before, right, forward), tip(after, right, forward), tip(after, left, forward)],
    });
    first = last;
  }
  return found;
}

export function boomLines(valves, vehicle, duty) {
  const point = [0, vehicle.east_m, vehicle.north_m, vehicle.heading_deg ?? 0];
  return valves.map((valve, index) => ({
    isOpen: (duty?.[index] ?? 0) > 0,
    ends: [
      tip(point, valve.right_m - valve.width_m / 2 + 0.06, valve.forward_m),
      tip(point, valve.right_m + valve.width_m / 2 - 0.06, valve.forward_m),
    ],
  }));
}

// As on every picture of the map, pale to dark; at night, on dark ground, dark to pale.
const NIGHT = ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"];
const DAY = NIGHT.toReversed();

function mix(a, b, share) {
  const part = (k) => Math.round(parseInt(a.slice(k, k + 2), 16) * (1 - share) + parseInt(b.slice(k, k + 2), 16) * share);
  return `rgb(${part(1)},${part(3)},${part(5)})`;
}

// How far the rate at a point of the way is from the map's, as a share; null where there is none.
// Orders lead the ground by up to `aheadS`, and points are a metre apart: a change under way is no error.
export function offBy(points, index, aheadS) {
  const [time, , , , , rate] = points[index];
  let off = null;
  for (let k = index; rate > 0 && k < points.length && (k === index || points[k - 1][0] <= time + aheadS); k += 1) {
    const wanted = points[k][6];
    if (wanted > 0 && (off === null || Math.abs(rate / wanted - 1) < Math.abs(off))) off = rate / wanted - 1;
  }
  return off;
}

// Too little is red, too much is blue, as in the report.
const STEPS = [-0.2, -0.1, 0.1, 0.2];
const OFF_WORDS = ["< −20", "−20 to −10", "± 10", "10 to 20", "> 20"];
const OFF_DAY = ["#b2182b", "#ef8a62", "#8f9a92", "#67a9cf", "#2166ac"];
const OFF_NIGHT = ["#e04a4a", "#f4a582", "#66747a", "#92c5de", "#4393f0"];

// The rates at both ends of a map's scale of colours: `rate_ends` of companion/map_pictures.py.
export function rateEnds(rates) {
  const above = rates.some((rate) => rate > 0) ? rates.filter((rate) => rate > 0) : [1];
  const least = Math.min(...above), most = Math.max(...above), beyond = (most - least) / 4 || most / 2;
  return [Math.max(least - beyond, 0), most + beyond];
}

// Rates as colours; or what is off from the map's.
export class Scale {
  constructor(rates, theme, { aheadS = 0, byError = false } = {}) {
    this.aheadS = aheadS;
    this.byError = byError;
    this.off = theme === "night" ? OFF_NIGHT : OFF_DAY;
    [this.low, this.high] = rateEnds(rates);
    this.stops = theme === "night" ? NIGHT : DAY;
    this.none = theme === "night" ? "rgb(42,52,58)" : "rgb(205,210,203)";
  }

  // What was treated from a point of the way on.
  treated(points, index) {
    if (!this.byError) return this.color(points[index][5]);
    const off = offBy(points, index, this.aheadS);
    return off === null ? this.none : this.off[STEPS.filter((step) => off > step).length];
  }

  errors() {
    return this.off.map((color, k) => [color, OFF_WORDS[k]]);
  }

  // The same as an expression of MapLibre's.
  fill(rate) {
    const step = (this.high - this.low) / (this.stops.length - 1);
    const scaled = this.stops.flatMap((color, k) => [this.low + step * k, color]);
    return ["case", ["<=", rate, 0], this.none, ["interpolate", ["linear"], rate, ...scaled]];
  }

  color(rate) {
    if (!(rate > 0)) return this.none;
    const share = Math.min(Math.max((rate - this.low) / (this.high - this.low), 0), 1);
    const place = share * (this.stops.length - 1);
    const index = Math.min(Math.floor(place), this.stops.length - 2);
    return mix(this.stops[index], this.stops[index + 1], place - index);
  }
}

// The room that tools, legend and scale take around the field: the aircraft is under none of them.
export function margins(element) {
  return element.clientWidth < 600
    ? { left: 14, right: 14, top: 62, bottom: 84 }
    : { left: 120, right: 100, top: 24, bottom: 44 };
}
