// Colours of the 3D view, taken from the style sheet so that both follow the reader's light or dark preference.

import { Color } from '../vendor/three.bundle.min.js';

// Small to large residuals; told apart by readers with colour-blindness too.
const RAMP = ['#3f9cf5', '#93cdf0', '#ffe48f', '#ff9f40', '#e0352b'];

/** The custom property --name of the page as a colour in display space. */
export function themeColour(name) {
  const value = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  return displayColour(value);
}

/** The colour at `share` 0..1 of the ramp. */
export function rampColour(share) {
  const at = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return displayColour(RAMP[low]).lerp(displayColour(RAMP[low + 1]), at - low);
}

/** The ramp's stops, for the shader. */
export const rampStops = () => RAMP.map(displayColour);

export const cssColour = ({ r, g, b }) => `rgb(${[r, g, b].map((part) => Math.round(part * 255)).join(' ')})`;

/** Calls back when the reader's preference changes. */
export function onThemeChange(callback) {
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', callback);
}

// The shaders write display colours as they are, so three.js must not take them to its linear working space.
function displayColour(text) {
  const colour = new Color();
  const [, hex] = /^#([0-9a-f]{6})$/i.exec(text) ?? [];
  if (!hex) return colour.setRGB(0.5, 0.5, 0.5);
  const part = (from) => parseInt(hex.slice(from, from + 2), 16) / 255;
  colour.r = part(0);
  colour.g = part(2);
  colour.b = part(4);
  return colour;
}
