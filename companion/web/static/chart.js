// Flow over the last minute: what is wanted, what is ordered, what the meter counts.

import uPlot from "./vendor/uplot/uPlot.esm.js";
import { unitOf, value } from "./units.js";

const SPAN_S = 60;

export class FlowChart {
  constructor(element) {
    this.element = element;
    this.rows = [[], [], [], []];
    this.plot = null;
    this.last = 0;
  }

  add(state) {
    if (this.rows[0].length && state.now_s <= this.rows[0].at(-1)) {
      if (state.now_s < this.rows[0].at(-1) - 1) this.rows = [[], [], [], []];
      return;
    }
    const values = [state.now_s, state.target_l_min, state.flow_l_min, state.meter_l_min ?? null];
    values.forEach((one, k) => this.rows[k].push(one));
    while (this.rows[0][0] < state.now_s - SPAN_S) this.rows.forEach((row) => row.shift());
    const now = performance.now();
    if (now - this.last < 450 || document.hidden) return;
    this.last = now;
    this.draw();
  }

  draw() {
    if (!this.element.clientWidth) return;
    if (!this.plot) this.plot = this.make();
    const end = this.rows[0].at(-1) ?? 0;
    this.plot.batch(() => {
      this.plot.setData(this.rows, false);
      this.plot.setScale("x", { min: end - SPAN_S, max: end });
      this.plot.setScale("y", { min: 0, max: Math.max(1, ...this.rows.slice(1).flat().filter((v) => v !== null)) * 1.15 });
    });
  }

  make() {
    const css = getComputedStyle(document.documentElement);
    const ink = css.getPropertyValue("--soft").trim(), line = css.getPropertyValue("--line").trim();
    const color = (name) => css.getPropertyValue(name).trim();
    const font = "12px system-ui, sans-serif";
    return new uPlot({
      width: this.element.clientWidth, height: 118, padding: [6, 8, 0, 0],
      cursor: { show: false }, legend: { show: false },
      scales: { x: { time: false, auto: false }, y: { auto: false } },
      axes: [
        { stroke: ink, font, size: 22, grid: { show: false }, ticks: { show: false }, splits: (plot, axis, low, high) => [high - 60, high - 40, high - 20, high - 1], values: (plot, splits) => splits.map((at, k) => ["60 s", "40", "20", "now"][k]) },
        { stroke: ink, font, size: 38, grid: { stroke: line, width: 1 }, ticks: { show: false }, space: 28, values: (plot, splits) => splits.map((at) => value("flow", at).replace(/0$/, "")) },
      ],
      series: [
        {},
        { stroke: color("--target"), width: 2, dash: [6, 4], points: { show: false } },
        { stroke: color("--bar"), width: 2.5, points: { show: false } },
        { stroke: color("--metered"), width: 2, points: { show: false } },
      ],
    }, [[], [], [], []], this.element);
  }

  restyle() {
    this.plot?.destroy();
    this.plot = null;
    this.draw();
  }
}
