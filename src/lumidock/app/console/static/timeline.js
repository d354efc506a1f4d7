// Trust over time as a strip: full height and plain for valid, two thirds and hatched for guide, a low bar for none.

import { el } from './api.js';

const HEIGHT = { v: 1, g: 0.66, n: 0.25 };

export class Timeline {
  constructor({ small = false, label = 'trust over time', pick = null } = {}) {
    this.canvas = el('canvas', { role: 'img', 'aria-label': label });
    this.root = el('div', { class: `strip${small ? ' small' : ''}` }, this.canvas);
    this.state = { trust: '', count: 1, first: 0, cursor: null, events: [], bookmarks: [], stretch: null };
    if (pick) {
      const at = (event) => {
        const share = (event.clientX - this.canvas.getBoundingClientRect().left) / this.canvas.clientWidth;
        pick(Math.max(0, Math.min(this.state.count - 1, Math.floor(share * this.state.count))));
      };
      this.canvas.addEventListener('pointerdown', (event) => { this.canvas.setPointerCapture(event.pointerId); at(event); });
      this.canvas.addEventListener('pointermove', (event) => { if (event.buttons) at(event); });
    }
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
  }

  set(state) {
    Object.assign(this.state, state);
    this.draw();
  }

  draw() {
    const { trust, count, first, cursor, events, bookmarks, stretch } = this.state;
    const ratio = window.devicePixelRatio || 1, width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width) return;
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    const context = this.canvas.getContext('2d'), style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(name).trim();
    const fills = { v: color('--valid'), g: hatched(context, color('--guide')), n: color('--none') };
    context.scale(ratio, ratio);
    const each = width / count;
    if (stretch) {
      context.fillStyle = color('--line');
      context.fillRect(stretch[0] * each, 0, (stretch[1] - stretch[0] + 1) * each, height);
    }
    for (let k = 0; k < trust.length;) { // runs of the same trust at once: no seams between frames
      let end = k + 1;
      while (end < trust.length && trust[end] === trust[k]) end += 1;
      const tall = HEIGHT[trust[k]] * (height - 12);
      context.fillStyle = fills[trust[k]];
      context.fillRect((first + k) * each, height - tall, (end - k) * each, tall);
      k = end;
    }
    context.fillStyle = color('--text');
    for (const event of events) mark(context, (event.index + 0.5) * each, event.kind === 'loss');
    for (const index of bookmarks) context.fillRect((index + 0.5) * each - 2, 0, 4, 9);
    if (cursor !== null) context.fillRect((cursor + 0.5) * each - 1, 0, 2, height);
  }
}

function hatched(context, color) {
  const tile = document.createElement('canvas');
  tile.width = tile.height = 8;
  const pen = tile.getContext('2d');
  pen.fillStyle = color;
  pen.fillRect(0, 0, 8, 8);
  pen.strokeStyle = '#0006';
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(-2, 10);
  pen.lineTo(10, -2);
  pen.stroke();
  return context.createPattern(tile, 'repeat');
}

// A loss points down, an alarm is a square.
function mark(context, x, loss) {
  context.beginPath();
  if (loss) {
    context.moveTo(x - 4, 1);
    context.lineTo(x + 4, 1);
    context.lineTo(x, 9);
  } else {
    context.rect(x - 3, 2, 6, 6);
  }
  context.fill();
}
