// A box around the thing that was clicked: what is connected near the click, above what it stands on.

import { axesOf, samplesOf } from './samples.js';

const LEVEL = 0.9; // |cosine| to up from which a surface may carry things
const UPRIGHT = 0.3;
const TURNS = 36;
const SECTORS = 16;
const SURROUNDED = 0.75; // share of the sectors round a thing in which its support goes on
const WIDE = 0.6; // of the scene's extent: no thing, but what holds all of it
const PAD = 0.03;

/** Proposes boxes on one surface; its samples are taken once. */
export class Proposer {
  constructor(geometry, up) {
    this.axes = axesOf(up);
    this.samples = samplesOf(geometry, up);
    this.isWall = wallsOf(this.samples);
  }

  /**
   * Boxes { center, size, yaw } around what is at `point`, in the scene's frame, the likeliest first: a thing on a table
   * may be meant with the table. There is always one.
   */
  around(point) {
    const { axis, sign, u, v } = this.axes;
    const hit = { u: point[u], v: point[v], height: sign * point[axis] };
    const things = this.supports(hit).map((height) => this.thingAbove(height, hit)).filter(Boolean);
    const [floor] = things.slice(-1);
    const chosen = things.filter((thing) => thing === floor || this.isSurrounded(thing));
    const boxes = chosen.map((thing) => this.boxOf(thing));
    return boxes.length ? boxes : [this.plainBox(hit)];
  }

  /** Heights of level surfaces below the click, the highest first; the last one is the largest: the floor. */
  supports(hit) {
    const { samples } = this;
    const step = samples.voxel;
    const areas = new Map();
    for (let i = 0; i < samples.count; i += 1) {
      if (samples.level[i] < LEVEL || samples.height[i] > hit.height + step) continue;
      const bin = Math.floor(samples.height[i] / step);
      areas.set(bin, (areas.get(bin) ?? 0) + samples.area);
    }
    const area = (bin) => areas.get(bin) ?? 0;
    const peaks = [...areas.keys()].filter((bin) => area(bin) >= area(bin - 1) && area(bin) > area(bin + 1) && area(bin) > 4 * step * step);
    const floor = peaks.reduce((best, bin) => (best === null || area(bin) > area(best) ? bin : best), null);
    return peaks.filter((bin) => floor === null || bin >= floor).sort((a, b) => b - a).map((bin) => this.heightOf(bin));
  }

  /** The mean height of the level samples in a bin and those beside it. */
  heightOf(bin) {
    const { samples } = this;
    const step = samples.voxel;
    let [sum, count] = [0, 0];
    for (let i = 0; i < samples.count; i += 1) {
      if (samples.level[i] < LEVEL || Math.abs(samples.height[i] / step - bin - 0.5) > 1) continue;
      sum += samples.height[i];
      count += 1;
    }
    return sum / count;
  }

  /** { base, members } of what is connected to the click above a support; null where nothing is, or the whole scene. */
  thingAbove(base, hit) {
    const { samples } = this;
    const step = samples.voxel;
    const cells = new Map();
    for (let i = 0; i < samples.count; i += 1) {
      if (samples.height[i] < base + 0.8 * step || this.isWall[i]) continue;
      const key = cellOf(samples.u[i] / step, samples.v[i] / step, samples.height[i] / step);
      if (cells.has(key)) cells.get(key).push(i);
      else cells.set(key, [i]);
    }
    const start = nearestCell(cells, [hit.u / step, hit.v / step, hit.height / step]);
    if (start === null) return null;
    const members = connected(cells, start);
    const [wide, deep] = [samples.u, samples.v].map((values) => spanOf(members, values));
    const isAll = wide > WIDE * samples.across[0] || deep > WIDE * samples.across[1];
    return isAll || members.length < 12 ? null : { base, members };
  }

  /** Whether the support goes on round the thing: a seat below a backrest does not. */
  isSurrounded({ base, members }) {
    const { samples } = this;
    const box = this.boxOf({ base, members });
    const [cu, cv] = [box.center[this.axes.u], box.center[this.axes.v]];
    const reach = Math.hypot(box.size[this.axes.u], box.size[this.axes.v]) / 2;
    const found = new Set();
    for (let i = 0; i < samples.count; i += 1) {
      if (samples.level[i] < LEVEL || Math.abs(samples.height[i] - base) > samples.voxel) continue;
      const [du, dv] = [samples.u[i] - cu, samples.v[i] - cv];
      const away = Math.hypot(du, dv);
      if (away < reach || away > reach + 4 * samples.voxel) continue;
      found.add(Math.floor(((Math.atan2(dv, du) + Math.PI) / (2 * Math.PI)) * SECTORS) % SECTORS);
    }
    return found.size >= SURROUNDED * SECTORS;
  }

  /** The smallest upright box around a thing, down to its support. */
  boxOf({ base, members }) {
    const { samples, axes } = this;
    let best = null;
    for (let turn = 0; turn < TURNS; turn += 1) {
      const yaw = (turn / TURNS) * (Math.PI / 2);
      const fit = rectangle(members, samples, yaw);
      if (!best || fit.wide * fit.deep < 0.93 * best.wide * best.deep) best = fit;
    }
    const top = members.reduce((high, i) => Math.max(high, samples.height[i]), -Infinity);
    const pad = samples.voxel / 2;
    const size = [0, 0, 0];
    size[axes.u] = best.wide * (1 + PAD) + pad;
    size[axes.v] = best.deep * (1 + PAD) + pad;
    size[axes.axis] = (top - base) * (1 + PAD) + pad;
    const center = [0, 0, 0];
    center[axes.u] = best.u;
    center[axes.v] = best.v;
    center[axes.axis] = axes.sign * (base + (top - base) / 2);
    return { center, size, yaw: best.yaw };
  }

  /** Where nothing stands: a box to start from. */
  plainBox(hit) {
    const { axis, sign, u, v } = this.axes;
    const edge = 0.15 * Math.max(...this.samples.across);
    const center = [0, 0, 0];
    [center[u], center[v], center[axis]] = [hit.u, hit.v, sign * (hit.height + edge / 2)];
    return { center, size: [edge, edge, edge], yaw: 0 };
  }
}

const BASE = 4096;
const cellOf = (x, y, z) => ((Math.floor(x) + BASE / 2) * BASE + Math.floor(y) + BASE / 2) * BASE + Math.floor(z) + BASE / 2;

function nearestCell(cells, [x, y, z]) {
  let [best, least] = [null, Infinity];
  for (let i = -3; i <= 3; i += 1) for (let j = -3; j <= 3; j += 1) for (let k = -3; k <= 3; k += 1) {
    const square = i * i + j * j + k * k;
    const key = cellOf(x + i, y + j, z + k);
    if (square < least && cells.has(key)) [best, least] = [key, square];
  }
  return best;
}

/** The samples of all cells that are connected to the first, corners included. */
function connected(cells, start) {
  const seen = new Set([start]);
  const open = [start];
  const members = [];
  while (open.length) {
    const key = open.pop();
    members.push(...cells.get(key));
    for (let i = -1; i <= 1; i += 1) for (let j = -1; j <= 1; j += 1) for (let k = -1; k <= 1; k += 1) {
      const next = key + (i * BASE + j) * BASE + k;
      if (seen.has(next) || !cells.has(next)) continue;
      seen.add(next);
      open.push(next);
    }
  }
  return members;
}

function spanOf(members, values) {
  let [low, high] = [Infinity, -Infinity];
  for (const i of members) {
    low = Math.min(low, values[i]);
    high = Math.max(high, values[i]);
  }
  return high - low;
}

/** The rectangle around the members, its sides turned by yaw: { wide, deep, u, v, yaw }. */
function rectangle(members, { u, v }, yaw) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const i of members) {
    const [x, y] = [c * u[i] + s * v[i], c * v[i] - s * u[i]];
    x0 = Math.min(x0, x);
    x1 = Math.max(x1, x);
    y0 = Math.min(y0, y);
    y1 = Math.max(y1, y);
  }
  const [x, y] = [(x0 + x1) / 2, (y0 + y1) / 2];
  return { wide: x1 - x0, deep: y1 - y0, u: c * x - s * y, v: s * x + c * y, yaw };
}

/** Which samples lie on upright planes that span most of the scene: a thing against a wall is none of it. */
function wallsOf(samples) {
  const step = samples.voxel;
  const bins = new Map();
  const upright = [];
  for (let i = 0; i < samples.count; i += 1) {
    if (samples.level[i] > UPRIGHT) continue;
    const turn = Math.round((samples.angle[i] / Math.PI) * 60) % 60;
    const [c, s] = [Math.cos((turn / 60) * Math.PI), Math.sin((turn / 60) * Math.PI)];
    const key = turn * BASE + Math.round((c * samples.u[i] + s * samples.v[i]) / step) + BASE / 2;
    const bin = bins.get(key) ?? bins.set(key, { along: [Infinity, -Infinity], up: [Infinity, -Infinity], area: 0 }).get(key);
    widen(bin.along, c * samples.v[i] - s * samples.u[i]);
    widen(bin.up, samples.height[i]);
    bin.area += samples.area;
    upright.push([i, key]);
  }
  const wide = 0.5 * Math.min(...samples.across);
  const tall = 0.5 * samples.tall;
  const walls = new Set();
  for (const [key, { along, up, area }] of bins) {
    const [length, height] = [along[1] - along[0], up[1] - up[0]];
    if (length < wide || height < tall || area < 0.25 * length * height) continue;
    for (const beside of [-1, 0, 1]) walls.add(key + beside);
  }
  const isWall = new Uint8Array(samples.count);
  for (const [i, key] of upright) isWall[i] = walls.has(key) ? 1 : 0;
  return isWall;
}

function widen(ends, value) {
  ends[0] = Math.min(ends[0], value);
  ends[1] = Math.max(ends[1], value);
}
