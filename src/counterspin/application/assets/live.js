// @ts-check
// A campaign while its records grow.

import { campaignAddress } from "./addresses.js";
import { get, Refused } from "./api.js";
import { commandLine, labelled, make, say, warning } from "./dom.js";
import { campaignTabs, reachedBy } from "./tabs.js";

const PAUSE = 1000;
const HEIGHT = 220;

/** @typedef {import("./answers.js").CurrentUncertainties} CurrentUncertainties */

/** The u of each coefficient over the minutes that are recorded, as far as this page has seen. */
class UncertaintyChart {
  constructor() {
    this.seen = /** @type {CurrentUncertainties[]} */ ([]);
    this.box = make("div", { class: "canvas", role: "img", "aria-label": "Standard uncertainty versus recorded time" });
    this.element = make("figure", { hidden: true }, make("figcaption", {},
      "Standard uncertainty versus recorded time, since this page was opened"), this.box);
    /** @type {any} */
    this.chart = null;
    new ResizeObserver(() => {
      const width = this.box.clientWidth;
      if (width && this.chart && this.chart.width !== width) this.chart.setSize({ width, height: HEIGHT });
    }).observe(this.box);
    globalThis.counterspin.redraws.push(() => this.chart?.redraw(false));
  }

  /** @param {CurrentUncertainties} reached */
  add(reached) {
    // Before anything is determined there is nothing to draw.
    if (!this.seen.length && !reached.u.some(({ u }) => u)) return;
    this.seen = withPoint(this.seen, reached);
    // A point alone is said in the table.
    if (this.seen.length < 2) return;
    this.element.hidden = false;
    if (!this.chart) this.make();
    this.chart.setData(columnsOf(this.seen));
  }

  make() {
    const { axis, colour } = globalThis.counterspin;
    this.chart = new /** @type {any} */ (globalThis).uPlot({
      width: this.box.clientWidth,
      height: HEIGHT,
      cursor: { y: false },
      scales: { x: { time: false }, y: { distr: 3, range: (/** @type {any} */ _, /** @type {number} */ low, /** @type {number} */ high) => {
        const steps = stepsAround(low, high);
        return [steps[0], steps[steps.length - 1]];
      } } },
      axes: [axis("recorded time, min", 34), {
        ...axis("standard uncertainty", 70),
        splits: (/** @type {any} */ _, /** @type {number} */ __, /** @type {number} */ low, /** @type {number} */ high) => stepsAround(low, high),
        filter: (/** @type {any} */ _, /** @type {number[]} */ steps) => steps,
        values: (/** @type {any} */ _, /** @type {number[]} */ steps) => steps.map(String),
      }],
      series: [{ label: "recorded time, min" }, ...this.seen[0].u.map(({ name }, place) =>
        ({ label: name, stroke: () => colour(`--series-${(place % 6) + 1}`), width: 2 }))],
    }, columnsOf(this.seen), this.box);
  }
}

/**
 * The steps 1, 2, 5, 10, and so on, from the last one below a range to the first one above it.
 * @param {number} low
 * @param {number} high
 */
export function stepsAround(low, high) {
  const steps = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
    for (const digit of [1, 2, 5]) steps.push(Number(`${digit}e${power}`));
  }
  const first = steps.findLastIndex((step) => step <= low);
  const last = steps.findIndex((step) => step > low && step >= high);
  return steps.slice(first, last + 1);
}

/**
 * What was reached with one more look; a look at the same minutes takes the place of the last.
 * @param {CurrentUncertainties[]} seen
 * @param {CurrentUncertainties} reached
 */
export function withPoint(seen, reached) {
  const before = seen.filter(({ minutes }) => minutes < reached.minutes);
  return [...before, reached];
}

/**
 * Minutes, then the u of each coefficient; a logarithmic axis has no place for none and for 0.
 * @param {CurrentUncertainties[]} seen
 */
export const columnsOf = (seen) => [
  seen.map(({ minutes }) => minutes),
  ...seen[0].u.map((_, place) => seen.map(({ u }) => u[place].u || null)),
];

/**
 * The live view of a campaign.
 * @param {string} name
 */
export async function liveView(name) {
  const campaign = await get("campaign", { name });
  const goal = make("input", { placeholder: "K_II 1e-8 g/g^2", autocomplete: "off", "aria-describedby": "goal-mistake" });
  const place = make("div", {}, make("p", { class: "quiet" }, "Reading the records. This takes a few seconds the first time."));
  const events = make("ul", { class: "quiet", "aria-live": "polite" });
  const command = make("div");
  const chart = new UncertaintyChart();
  const wrong = make("div", { id: "goal-mistake" });
  let shown = "";
  let wanted = "";
  let looking = false;
  /** @returns {Promise<void>} */
  const look = async () => {
    looking = place.isConnected;
    if (!looking) return;
    const asked = wanted;
    try {
      const told = await get("watch", { name, goal: asked });
      if (asked !== wanted) return look();
      if (told.error) {
        looking = false;
        place.replaceChildren(warning(told.error));
        return;
      }
      if (told.html && told.html !== shown) {
        shown = told.html;
        if (told.reached) chart.add(told.reached);
        // Escaped by the report's own templates.
        place.innerHTML = told.html;
        place.querySelector("h1")?.remove();
        command.replaceChildren(commandLine(told.command));
        globalThis.counterspin.draw(place);
        told.events.forEach(/** @param {string} one */ (one) => events.prepend(make("li", {}, one)));
      }
      if (told.complete) {
        say("All runs have been recorded.");
        place.append(make("p", {}, make("a", { class: "button", href: campaignAddress(name) }, "Continue to the result")));
        looking = false;
        return;
      }
    } catch (error) {
      if (asked !== wanted) return look();
      const words = warning(/** @type {Error} */ (error).message);
      if (!asked || !(error instanceof Refused) || error.status !== 422) {
        looking = false;
        place.replaceChildren(words);
        return;
      }
      // The goal is wrong, and the records are followed without it.
      wrong.replaceChildren(words);
      goal.setAttribute("aria-invalid", "true");
      if (wanted === asked) wanted = "";
    }
    setTimeout(look, PAUSE);
  };
  goal.addEventListener("change", () => {
    wanted = goal.value.trim();
    shown = "";
    wrong.replaceChildren();
    goal.removeAttribute("aria-invalid");
    // What is complete, or could not be followed, is looked at again for another goal.
    if (!looking) look();
  });
  setTimeout(look);
  return {
    title: `Live: ${campaign.title}`,
    content: [
      make("h1", {}, campaign.title), campaignTabs(name, "live", reachedBy(campaign)),
      make("p", { class: "quiet" }, "While your recorder writes records into the campaign folder, this page reads the records every second. "
        + "The ripple is given as a fraction of the rate. The residuals should be about as large as the noise."),
      make("div", { class: "row" }, labelled("Goal (coefficient and standard uncertainty)", goal)), wrong, chart.element, place, events, command,
    ],
  };
}
