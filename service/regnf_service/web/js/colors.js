// Colors of the 3D view, taken from the style sheet so that both follow the reader's light or dark preference.

import { Color } from '../vendor/three.bundle.min.js';

// Small to large residuals; told apart by readers with color-blindness too.
const RAMP = ['#3f9cf5', '#93cdf0', '#ffe48f', '#ff9f40', '#e0352b'];

/** The custom property --name of the page as a color in display space. */
export function themeColor(name) {
  const value = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  return displayColor(value);
}

/** The color at `share` 0..1 of the ramp. */
export function rampColor(share) {
  const at = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return displayColor(RAMP[low]).lerp(displayColor(RAMP[low + 1]), at - low);
}

/** The ramp's stops, for the shader. */
export const rampStops = () => RAMP.map(displayColor);

export const cssColor = ({ r, g, b }) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(' ')})`;

/** Calls back when the reader's preference changes. */
export function onThemeChange(callback) {
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', callback);
}

// The shaders write display colors as they are, so three.js must not take them to its linear working space.
function displayColor(text) {
  const color = new Color();
  const [, hex] = /^#([0-9a-f]{6})$/i.exec(text) ?? [];
  if (!hex) return color.setRGB(0.5, 0.5, 0.5);
  const part = (from) => parseInt(hex.slice(from, from + 2), 16) / 255;
  color.r = part(0);
  color.g = part(2);
  color.b = part(4);
  return color;
}
