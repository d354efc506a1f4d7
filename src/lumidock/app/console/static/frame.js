// One frame: the picture with its marks, trust and its reason, levels, stage, plans, and when each light was last seen.

import { el, number, svg } from './api.js';
import { Plans } from './plans.js';

const STAGES = ['search', 'front', 'transition', 'rear'];
const TRUST = { valid: 'VALID', guide: 'GUIDE ONLY', none: 'NO FIX' };
const RECENT_S = 0.5; // a light seen so lately is drawn filled

// A disc, a triangle and a cross: the same without colour.
function trustIcon(trust) {
  const shape = {
    valid: [svg('circle', { cx: 16, cy: 16, r: 14, class: 'fill-valid' }),
      svg('path', { d: 'M9 17l5 5 9-11', fill: 'none', stroke: '#fff', 'stroke-width': 3.5 })],
    guide: [svg('path', { d: 'M16 2L31 29H1z', class: 'fill-guide' }),
      svg('path', { d: 'M16 11v9M16 23v3', stroke: '#000', 'stroke-width': 3 })],
    none: [svg('rect', { x: 2, y: 2, width: 28, height: 28, rx: 3, class: 'fill-none' }),
      svg('path', { d: 'M9 9l14 14M23 9L9 23', stroke: '#fff', 'stroke-width': 3.5 })],
  }[trust] ?? [svg('circle', { cx: 16, cy: 16, r: 14, class: 'fill-off' })];
  return svg('svg', { viewBox: '0 0 32 32', 'aria-hidden': 'true' }, ...shape);
}

function outline(rank, x, y, r, attributes) {
  return rank === 0
    ? svg('circle', { cx: x, cy: y, r, ...attributes })
    : svg('path', { d: `M${x} ${y - 1.25 * r}L${x + 1.25 * r} ${y}L${x} ${y + 1.25 * r}L${x - 1.25 * r} ${y}z`, ...attributes });
}

function ticks(x, y, near, far) {
  return `M${x} ${y - far}V${y - near}M${x} ${y + near}V${y + far}M${x - far} ${y}H${x - near}M${x + near} ${y}H${x + far}`;
}

export class FrameView {
  constructor(about, title = '') {
    this.about = about;
    this.rank = new Map(about.lights.map((light) => [light.id, Math.min(1, about.layers.indexOf(light.layer))]));
    this.canvas = el('canvas', { width: 1, height: 1, role: 'img', 'aria-label': 'picture of the camera' });
    this.marks = svg('svg', { viewBox: `-0.5 -0.5 ${about.width} ${about.height}`, preserveAspectRatio: 'none' });
    this.empty = el('p', { class: 'empty' }, 'no picture yet');
    this.picture = el('div', { class: 'picture' }, this.canvas, this.marks, this.empty);
    this.zoomed = false;
    this.picture.style.aspectRatio = `${about.width} / ${about.height}`;
    this.hint = el('output', { class: 'hint' });
    this.trust = el('div', { class: 'card trust', 'aria-live': 'polite' }, trustIcon(''), el('p', {}, 'No frame yet.'));
    this.numbers = el('dl', { class: 'pairs' });
    this.levels = el('div');
    this.stages = el('ol', { class: 'stages', 'aria-label': 'docking stage' });
    this.lights = el('ul', { class: 'lights' });
    this.rejected = el('ul');
    this.rejectedCount = el('summary', {}, 'no rejected detections');
    this.more = el('dl', { class: 'pairs' });
    this.advice = el('div', { class: 'card advice', hidden: true, 'aria-live': 'polite' });
    this.moreCard = el('div', { class: 'card', hidden: true }, el('h2', {}, 'Also known'), this.more);
    this.title = el('h2', {}, title || 'Camera');
    this.plans = new Plans(about);
    this.root = this.#laidOut();
    new ResizeObserver(() => { if (this.state) this.#mark(this.state); }).observe(this.picture);
  }

  #laidOut() {
    const bright = el('button', { type: 'button', 'aria-pressed': 'false' }, 'Brighten');
    bright.addEventListener('click', () => {
      bright.setAttribute('aria-pressed', String(this.picture.classList.toggle('bright')));
    });
    this.zoom = el('button', { type: 'button', 'aria-pressed': 'false', onclick: () => this.setZoom(!this.zoomed) }, 'Zoom to lights');
    const left = el('div', {},
      el('div', { class: 'card' },
        el('div', { class: 'row' }, this.title, bright, this.zoom),
        this.picture, this.hint, this.#legend(),
        el('details', {}, this.rejectedCount, this.rejected)),
      this.plans.root);
    const right = el('div', {}, this.trust, this.advice,
      el('div', { class: 'card' }, el('h2', {}, 'Levels against alert limits'), this.levels),
      el('div', { class: 'card' }, el('h2', {}, 'Stage and position'), this.stages, el('p'), this.numbers),
      el('div', { class: 'card' }, el('h2', {}, 'Lights, and when each was last seen'), this.lights),
      this.moreCard);
    return el('section', { class: 'frame' }, left, right);
  }

  setZoom(zoomed) {
    this.zoomed = zoomed;
    this.zoom.setAttribute('aria-pressed', String(zoomed));
    if (this.state) this.#mark(this.state);
  }

  #legend() {
    const key = (node, text) => el('span', {}, svg('svg', { viewBox: '0 0 20 20', 'aria-hidden': 'true' }, node), text);
    const [front, rear] = this.about.layers;
    return el('div', { class: 'legend' },
      key(outline(0, 10, 10, 7, { class: 'mark front' }), front),
      rear ? key(outline(1, 10, 10, 6, { class: 'mark rear' }), rear) : null,
      key(svg('rect', { x: 3, y: 3, width: 14, height: 14, class: 'mark rejected' }), 'rejected'),
      key(svg('path', { d: ticks(10, 10, 3, 8), class: 'mark predicted' }), 'predicted'));
  }

  async update(state, jpeg) {
    await this.#draw(jpeg);
    this.#mark(state);
    this.#tell(state);
    this.#measure(state);
    this.#list(state);
    this.plans.update(state);
  }

  async #draw(jpeg) {
    this.empty.hidden = Boolean(jpeg);
    if (!jpeg) {
      this.canvas.width = this.canvas.height = 1;
      this.empty.textContent = 'no picture of this frame';
      return;
    }
    const bitmap = await createImageBitmap(jpeg);
    if (this.canvas.width !== bitmap.width || this.canvas.height !== bitmap.height) {
      this.canvas.width = bitmap.width;
      this.canvas.height = bitmap.height;
    }
    this.canvas.getContext('2d').drawImage(bitmap, 0, 0);
    bitmap.close();
  }

  // Scale and place picture and marks so that the identified lights fill them; returns by how much they are larger.
  #zoomTo(state) {
    const uv = state.detections.filter((d) => d.light).map((d) => d.uv);
    const side = [this.about.width, this.about.height];
    if (!this.zoomed || !uv.length) {
      this.canvas.style.transform = 'none';
      this.marks.setAttribute('viewBox', `-0.5 -0.5 ${side.join(' ')}`);
      return 1;
    }
    const [low, high] = [Math.min, Math.max].map((f) => side.map((_, k) => f(...uv.map((p) => p[k]))));
    const size = Math.max(...side.map((s, k) => (1.6 * (high[k] - low[k])) / s), 0.08);
    const times = Math.max(1, 1 / size);
    const corner = side.map((s, k) => Math.max(0, Math.min(s - s / times, (low[k] + high[k]) / 2 - s / times / 2)));
    const shift = side.map((s, k) => (-100 * times * corner[k]) / s);
    this.canvas.style.transform = `translate(${shift[0]}%, ${shift[1]}%) scale(${times})`;
    this.marks.setAttribute('viewBox', `${corner[0] - 0.5} ${corner[1] - 0.5} ${side[0] / times} ${side[1] / times}`);
    return times;
  }

  #mark(state) {
    this.state = state;
    const page = this.picture.clientWidth || this.about.width;
    const scale = this.about.width / page / this.#zoomTo(state); // image pixels per pixel of the page
    const identified = new Set(state.detections.map((d) => d.light));
    const nodes = [];
    const open = state.trust !== 'valid' ? ' open' : '';
    for (const { light, uv } of state.predicted) {
      const [near, far] = identified.has(light) ? [0, 4 * scale] : [6 * scale, 13 * scale]; // a missing one stands out
      nodes.push(svg('path', { class: `mark predicted${open}`, 'data-light': light,
        d: ticks(uv[0], uv[1], near, far) }));
    }
    for (const detection of state.detections) nodes.push(...this.#detection(detection, scale));
    this.marks.replaceChildren(...nodes);
  }

  #detection(d, scale) {
    const [x, y] = d.uv;
    const r = Math.max(9 * scale, 1.6 * (d.radius_px ?? 0) + 4 * scale);
    const chance = d.p_light === null ? '' : `, probability of a lamp ${d.p_light.toFixed(2)}`;
    const text = d.light ? `${d.light}: identified${chance}` : `Rejected. ${d.why}`;
    const told = { tabindex: d.light ? null : '0', 'aria-label': text, role: 'img',
      onpointerenter: () => { this.hint.textContent = text; }, onfocus: () => { this.hint.textContent = text; },
      onclick: () => { this.hint.textContent = text; this.picked?.(d); } };
    if (!d.light) {
      return [svg('rect', { x: x - r, y: y - r, width: 2 * r, height: 2 * r, class: 'mark rejected', ...told }, svg('title', {}, text))];
    }
    const rank = this.rank.get(d.light) ?? 0;
    const name = svg('text', { x: x + r + 3 * scale, y: y - 4 * scale, class: 'name' }, d.light);
    name.style.fontSize = `${13 * scale}px`;
    name.style.strokeWidth = `${3 * scale}px`;
    return [outline(rank, x, y, r, { class: `mark ${rank ? 'rear' : 'front'}`, ...told }), name];
  }

  #tell(state) {
    if (this.told === `${state.trust} ${state.sentence}`) return; // a screen reader should hear of changes alone
    this.told = `${state.trust} ${state.sentence}`;
    this.trust.className = `card trust ${state.trust}`;
    this.trust.replaceChildren(trustIcon(state.trust),
      el('strong', {}, TRUST[state.trust], state.reason ? el('code', {}, ` ${state.reason}`) : null),
      el('p', {}, state.sentence),
      el('p', { class: 'quiet' }, state.remedy ? `Remedy: ${state.remedy}` : ''));
  }

  #measure(state) {
    this.levels.replaceChildren(...(state.levels.length ? state.levels.map(level)
      : [el('p', { class: 'quiet' }, state.trust === 'valid' ? 'None: the method gives a pose without levels.' : 'None: there is neither a pose nor a guide.')]));
    this.stages.replaceChildren(...STAGES.map((stage) => el('li', { 'aria-current': stage === state.stage ? 'step' : null }, stage)));
    const rows = [['frame', state.frame], ['status', state.status],
      ['lights', `${state.n_used} used, ${state.n_seen} detections`]];
    if (state.pose) {
      const [x, y, z] = state.pose.position;
      rows.push(['position', `right ${number(x)}, up ${number(y)}, out ${number(z, 2, 'm')}`]);
    }
    if (state.guide) {
      const behind = Math.abs(state.guide.bearing_x_deg) > 90;
      rows.push(['bearing', behind ? 'the entrance is behind' : `right ${number(state.guide.bearing_x_deg)}, down ${number(state.guide.bearing_y_deg, 2, 'deg')}`],
        ['range', `${number(state.guide.range_m, 2)} ± ${number(state.guide.pl_range_m, 2, 'm')}`]);
    }
    if (state.nis !== null) rows.push(['innovation', `${number(state.nis)} (1 where noise is as stated)`]);
    if (state.latency_ms !== null) rows.push(['latency', number(state.latency_ms, 1, 'ms')]);
    for (const [k, one] of state.alternatives.entries()) {
      const [x, y, z] = one.position;
      rows.push([`fits ${k + 1}`, `${(100 * one.probability).toFixed(0)} %: ${number(x)}, ${number(y)}, ${number(z, 2, 'm')}; no fix`]);
    }
    this.numbers.replaceChildren(...rows.flatMap(([name, value]) => [el('dt', {}, name), el('dd', {}, value)]));
  }

  // Go / no-go, where the server knows the size of the vehicle and gives it.
  #advise(advice) {
    this.advice.hidden = !advice;
    if (!advice) return;
    const { verdict, word } = advice;
    this.advice.replaceChildren(el('h2', {}, 'Go / no-go'), el('strong', {}, String(verdict).replaceAll('_', ' ').toUpperCase()), word ? ` ${word}` : '');
  }

  #list(state) {
    const seen = state.last_seen_s ?? {};
    this.lights.replaceChildren(...this.about.lights.map((light) => {
      const ago = seen[light.id];
      const rank = this.rank.get(light.id);
      const text = ago === undefined ? 'never' : ago < 0.05 ? 'now' : ago < 100 ? `${ago.toFixed(1)} s` : `${Math.round(ago)} s`;
      return el('li', { class: ago !== undefined && ago < RECENT_S ? 'seen' : '' },
        svg('svg', { viewBox: '0 0 16 16', 'aria-hidden': 'true' }, outline(rank, 8, 8, 5, { class: `shape ${rank ? 'rear' : 'front'}` })),
        light.id, el('span', { class: 'quiet' }, text));
    }));
    const rejected = state.detections.filter((d) => !d.light);
    this.rejectedCount.textContent = `${rejected.length} rejected detections`;
    this.rejected.replaceChildren(...rejected.slice(0, 40).map((d) => el('li', {}, `(${number(d.uv[0], 0)}, ${number(d.uv[1], 0)}) ${d.why}`)));
    this.#advise(state.more.go_no_go);
    const more = Object.entries(state.more).filter(([name, value]) => name !== 'go_no_go' && value !== null);
    this.moreCard.hidden = more.length === 0;
    this.more.replaceChildren(...more.flatMap(([name, value]) => [el('dt', {}, called(name)), el('dd', {}, said(value))]));
  }
}

// linear_m_s: linear (m/s)
function called(name) {
  return name.replace(/_(m|rad)_s$/, ' ($1/s)').replace(/_(m|rad|deg|s|ms)$/, ' ($1)').replaceAll('_', ' ');
}

function said(value) {
  if (value === null) return '–';
  if (Array.isArray(value)) return value.map(said).join(', ');
  if (typeof value === 'object') return Object.entries(value).map(([name, one]) => `${called(name)} ${said(one)}`).join(', ');
  return String(typeof value === 'number' ? Number(value.toPrecision(3)) : value);
}

// A bar up to the level, with the limit as a line at four fifths of the width.
function level({ name, level: value, limit, unit }) {
  const share = value === null || !limit ? 1.25 : Math.min(value / limit, 1.25);
  const within = value !== null && limit !== null && value < limit;
  const text = `${number(value, value !== null && value < 0.1 ? 3 : 2)} of ${number(limit, 2, unit)}`;
  return el('div', { class: 'level' }, el('span', {}, name),
    svg('svg', { viewBox: '0 0 100 10', preserveAspectRatio: 'none', role: 'img', 'aria-label': `${name} ${text}` },
      svg('rect', { x: 0.5, y: 1, width: 99, height: 8, class: 'track' }),
      svg('rect', { x: 0, y: 2, width: 80 * share, height: 6, class: within ? 'fill-valid' : 'fill-none' }),
      svg('line', { x1: 80, x2: 80, y1: 0, y2: 10, class: 'limit', 'vector-effect': 'non-scaling-stroke' })),
    el('span', {}, `${text} ${within ? '✓' : '✕'}`));
}
