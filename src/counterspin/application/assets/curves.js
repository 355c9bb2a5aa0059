// @ts-check
// Small drawings of columns, and of the input axis at each position.

import { make } from "./dom.js";

/** @type {(name: string, attributes: Record<string, string|number>, ...children: Node[]) => SVGElement} */
const draw = (name, attributes, ...children) => {
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
export const tipOf = (degrees, radius) => {
  const angle = degrees * Math.PI / 180;
  return [Number((radius * Math.sin(angle)).toFixed(2)), Number((-radius * Math.cos(angle)).toFixed(2))];
};

/**
 * The direction of the input axis at each position, as arrows on a circle.
 * @param {number[]} directions from up, clockwise, deg
 */
export function circleOf(directions) {
  const label = `Input-axis direction at ${directions.length} positions, seen from the south, in degrees clockwise from up: ` +
    directions.map((angle) => Number(angle.toFixed(1))).join(", ");
  const arrows = directions.map((angle) => {
    const [x, y] = tipOf(angle, 80);
    return draw("g", {}, draw("path", { d: `M0 0L${x} ${y}` }), draw("circle", { cx: x, cy: y, r: 4 }));
  });
  const words = [["up", 0, "middle"], ["east", 90, "start"], ["down", 180, "middle"], ["west", 270, "end"]].map(([word, angle, anchor]) => {
    const [x, y] = tipOf(Number(angle), anchor === "middle" ? 98 : 90);
    return draw("text", { x, y: y + 4, "text-anchor": anchor }, document.createTextNode(String(word)));
  });
  return make("figure", {}, make("figcaption", {}, "Input-axis direction at each position, seen from the south"),
    draw("svg", { viewBox: "-130 -112 260 224", class: "circle", role: "img", "aria-label": label },
      draw("circle", { cx: 0, cy: 0, r: 80, class: "rim" }), ...arrows, ...words));
}

/**
 * The path through the least and greatest values of the parts of a curve, 1 wide each and 48 high.
 * @param {([number, number]|null)[]} extent
 */
export function curvePath(extent) {
  const known = extent.flatMap((part) => part ?? []);
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const height = (/** @type {number} */ value) => Number((45 - 42 * (high > low ? (value - low) / (high - low) : 0.5)).toFixed(2));
  let pen = "M";
  return extent.map((part, place) => {
    if (!part) {
      pen = "M";
      return "";
    }
    // Up and down in turn, so that the line goes on without a jump.
    const [first, last] = place % 2 ? [part[1], part[0]] : part;
    const piece = `${pen}${place} ${height(first)}L${place + 0.5} ${height(last)}`;
    pen = "L";
    return piece;
  }).join("");
}

/**
 * A drawing of a column, with its trend subtracted, and its range.
 * @param {string} name
 * @param {{extent: ([number, number]|null)[], words: string, size: number, unit: string}} curve
 */
export function curveOf(name, { extent, words, size, unit }) {
  const half = size && size < 1e-3 ? size.toExponential(1) : String(Number(size.toPrecision(3)));
  const range = size ? `± ${half}${unit ? ` ${unit}` : ""}` : "constant";
  return make("figure", { class: "curve" },
    draw("svg", { viewBox: `0 0 ${extent.length} 48`, role: "img", preserveAspectRatio: "none",
      "aria-label": `${name}, ${words}, ${range}` }, draw("path", { d: curvePath(extent) })),
    make("figcaption", {}, make("span", {}, words), make("span", {}, range)));
}
