// @ts-check
// Drawings of columns, and of the input axis at each position.

import { make } from "./dom.js";

/** @type {(name: string, attributes: Record<string, string|number>, ...children: Node[]) => SVGElement} */
const makeSvg = (name, attributes, ...children) => {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
  element.append(...children);
  return element;
};

/**
 * The tip of an arrow on a circle about 0.
 * @param {number} degrees from up, clockwise
 * @param {number} radius
 */
export const arrowTip = (degrees, radius) => {
  const angle = degrees * Math.PI / 180;
  return [Number((radius * Math.sin(angle)).toFixed(2)), Number((-radius * Math.cos(angle)).toFixed(2))];
};

/**
 * The direction of the input axis at each position, as arrows on a circle.
 * @param {number[]} directions from up, clockwise, deg
 */
export function directionCircle(directions) {
  const label = `Input-axis direction at ${directions.length} positions, seen from the south, in degrees clockwise from up: ` +
    directions.map((angle) => Number(angle.toFixed(1))).join(", ");
  const arrows = directions.map((angle) => {
    const [x, y] = arrowTip(angle, 80);
    return makeSvg("g", {}, makeSvg("path", { d: `M0 0L${x} ${y}` }), makeSvg("circle", { cx: x, cy: y, r: 4 }));
  });
  const labels = [["up", 0, "middle"], ["east", 90, "start"], ["down", 180, "middle"], ["west", 270, "end"]].map(([label, angle, anchor]) => {
    const [x, y] = arrowTip(Number(angle), anchor === "middle" ? 98 : 90);
    return makeSvg("text", { x, y: y + 4, "text-anchor": anchor }, document.createTextNode(String(label)));
  });
  return make("figure", {}, make("figcaption", {}, "Input-axis direction at each position, seen from the south"),
    makeSvg("svg", { viewBox: "-130 -112 260 224", class: "circle", role: "img", "aria-label": label },
      makeSvg("circle", { cx: 0, cy: 0, r: 80, class: "rim" }), ...arrows, ...labels));
}

/**
 * The path through minimum and maximum of the segments of a curve, each 1 wide; height 48.
 * @param {([number, number]|null)[]} extent
 */
export function curvePath(extent) {
  const values = extent.flatMap((segment) => segment ?? []);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const height = (/** @type {number} */ value) => Number((45 - 42 * (high > low ? (value - low) / (high - low) : 0.5)).toFixed(2));
  let command = "M";
  return extent.map((segment, index) => {
    if (!segment) {
      command = "M";
      return "";
    }
    // Alternate between up and down, so that the line is continuous.
    const [first, last] = index % 2 ? [segment[1], segment[0]] : segment;
    const path = `${command}${index} ${height(first)}L${index + 0.5} ${height(last)}`;
    command = "L";
    return path;
  }).join("");
}

/**
 * A drawing of a detrended column, with its range.
 * @param {string} name
 * @param {{extent: ([number, number]|null)[], words: string, size: number, unit: string}} curve
 */
export function curveFigure(name, { extent, words: description, size: halfRange, unit }) {
  const rangeText = halfRange && (halfRange < 1e-3 || halfRange >= 1e6) ? halfRange.toExponential(1) : String(Number(halfRange.toPrecision(3)));
  const range = halfRange ? `± ${rangeText}${unit ? ` ${unit}` : ""}` : "constant";
  return make("figure", { class: "curve" },
    makeSvg("svg", { viewBox: `0 0 ${extent.length} 48`, role: "img", preserveAspectRatio: "none",
      "aria-label": `${name}, ${description}, ${range}` }, makeSvg("path", { d: curvePath(extent) })),
    make("figcaption", {}, make("span", {}, description), make("span", {}, range)));
}
