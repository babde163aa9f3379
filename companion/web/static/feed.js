// The stream of states from the companion: it comes back by itself, and catches up on the way.

const RETRY_MS = 1000;

export class Feed {
  constructor({ onState, onWay, onLost }) {
    this.onState = onState;
    this.onWay = onWay;
    this.points = [];
    this.way = null;
    this.onLost = onLost;
    this.heardMs = null;
    this.ageS = null;
    this.source = null;
    setInterval(() => this.onLost(this.age()), 250);
    document.addEventListener("visibilitychange", () => { if (!document.hidden && this.age() > 2) this.open(); });
  }

  // How old the newest state is, in seconds; null before the first.
  age() {
    if (this.heardMs === null || this.ageS === null) return null;
    return this.ageS + (performance.now() - this.heardMs) / 1000;
  }

  open() {
    this.source?.close();
    clearTimeout(this.retry);
    this.source = new EventSource(`api/v1/events?since=${this.points.length}`);
    this.source.onmessage = (event) => this.take(JSON.parse(event.data));
    this.source.onerror = () => {
      this.source.close();
      clearTimeout(this.retry);
      this.retry = setTimeout(() => this.open(), RETRY_MS);
    };
  }

  take({ state, since, points, way }) {
    this.heardMs = performance.now();
    this.ageS = state.age_s ?? null;
    if (this.way !== null && way !== this.way) {
      this.way = way;
      this.points = [];
      this.onWay(this.points, 0);
      this.open();
      return;
    }
    this.way = way;
    if (since < this.points.length) this.points.length = since;
    const isReset = since < this.points.length || (since === 0 && points.length > 0);
    if (since === this.points.length && points.length) {
      this.points.push(...points);
      this.onWay(this.points, isReset ? 0 : since);
    }
    if (state.age_s !== null && state.age_s !== undefined) this.onState(state);
  }
}
