// The vehicle in the dock from above and from the side: lights, docking point, trail, and how far off it may be.

import { el, svg } from './api.js';

const WIDTH = 400, HEIGHT = 250, MARGIN = 34;

export class Plans {
  constructor(about) {
    this.about = about;
    this.trail = this.all = [];
    this.above = el('div', { class: 'plan card' });
    this.side = el('div', { class: 'plan card' });
    this.root = el('div', { class: 'plans' }, this.above, this.side);
  }

  // Positions of valid fixes, oldest first, and all positions that the plans have to hold.
  setTrail(positions, all = positions) {
    this.trail = positions;
    this.all = all;
  }

  update(state) {
    const view = this.#view(state);
    this.above.replaceChildren(el('h2', {}, 'From above'), this.#plan(state, view, 0, 1, 'right, m'));
    this.side.replaceChildren(el('h2', {}, 'From the side'), this.#plan(state, view, 1, -1, 'up, m'));
  }

  // Metres shown along z and across it: the dock, the vehicle and the trail, in one scale.
  #view(state) {
    const points = [...this.about.lights.map((light) => light.p_dock), this.about.docking_point, ...this.all];
    if (state.pose) points.push(state.pose.position);
    if (state.guide && !state.pose) points.push([0, 0, state.guide.range_m]);
    const z = points.map((p) => p[2]);
    const across = Math.max(1, ...points.map((p) => Math.max(Math.abs(p[0]), Math.abs(p[1]))));
    const low = Math.min(...z) - 0.5, high = Math.max(...z, 3) + 1;
    const scale = Math.min((WIDTH - 2 * MARGIN) / (high - low), (HEIGHT / 2 - MARGIN) / across);
    return { low, high, scale };
  }

  #plan(state, view, axis, sign, label) {
    const px = (p) => [MARGIN + (view.high - p[2]) * view.scale, HEIGHT / 2 + sign * p[axis] * view.scale];
    const nodes = [...this.#grid(view, px), svg('text', { x: 4, y: 12 }, label), svg('text', { x: 4, y: HEIGHT - 5 }, 'z, m')];
    for (const light of this.about.lights) {
      const [x, y] = px(light.p_dock);
      const rank = Math.min(1, this.about.layers.indexOf(light.layer));
      nodes.push(rank
        ? svg('path', { d: `M${x} ${y - 5}L${x + 5} ${y}L${x} ${y + 5}L${x - 5} ${y}z`, class: 'light rear' })
        : svg('circle', { cx: x, cy: y, r: 4, class: 'light front' }));
    }
    const [gx, gy] = px(this.about.docking_point);
    nodes.push(svg('path', { d: `M${gx - 6} ${gy - 6}l12 12M${gx + 6} ${gy - 6}l-12 12`, class: 'goal' }));
    if (this.trail.length > 1) nodes.push(svg('polyline', { points: this.trail.map((p) => px(p).join()).join(' '), class: 'trail' }));
    nodes.push(...(state.pose ? this.#vehicle(state, view, axis, sign, px) : this.#arc(state, view)));
    const name = state.pose ? `position ${state.pose.position.map((x) => x.toFixed(2)).join(', ')} m` : 'no position';
    return svg('svg', { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: 'img', 'aria-label': name }, ...nodes);
  }

  #grid(view, px) {
    const step = [1, 2, 5, 10, 20].find((metres) => (view.high - view.low) / metres < 9) ?? 50;
    const nodes = [svg('line', { x1: 0, x2: WIDTH, y1: HEIGHT / 2, y2: HEIGHT / 2, class: 'grid' })];
    for (let z = Math.ceil(view.low / step) * step; z <= view.high; z += step) {
      const [x] = px([0, 0, z]);
      nodes.push(svg('line', { x1: x, x2: x, y1: 16, y2: HEIGHT - 16, class: 'grid' }), svg('text', { x: x + 2, y: HEIGHT - 5 }, z));
    }
    return nodes;
  }

  #vehicle(state, view, axis, sign, px) {
    const [x, y] = px(state.pose.position), ahead = state.pose.ahead;
    const level = (name) => state.levels.find((one) => one.name === name)?.level ?? 0;
    const angle = Math.atan2(sign * ahead[axis], -ahead[2]) * 180 / Math.PI;
    return [
      svg('ellipse', { cx: x, cy: y, rx: level('axial') * view.scale, ry: level('lateral') * view.scale, class: 'bound' }),
      svg('path', { d: 'M11 0L-8 7L-4 0L-8 -7z', class: 'vehicle', transform: `translate(${x} ${y}) rotate(${angle})` }),
    ];
  }

  // With a guide alone only the distance is known: an arc about the dock's origin.
  #arc(state, view) {
    if (!state.guide) return [];
    const r = state.guide.range_m * view.scale, x0 = MARGIN + view.high * view.scale, half = Math.min(1, (HEIGHT / 2 - 20) / r);
    const a = Math.asin(half);
    return [svg('path', { class: 'arc', d: `M${x0 - r * Math.cos(a)} ${HEIGHT / 2 - r * Math.sin(a)}A${r} ${r} 0 0 0 ${x0 - r * Math.cos(a)} ${HEIGHT / 2 + r * Math.sin(a)}` }),
      svg('text', { x: x0 - r + 4, y: 26 }, 'range only')];
  }
}
