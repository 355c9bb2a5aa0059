// @ts-check
// A campaign during recording.

import { campaignAddress } from "./addresses.js";
import { get, RequestError } from "./api.js";
import { commandLine, labelled, make, say, warning } from "./dom.js";
import { campaignTabs, reachedStep } from "./tabs.js";

const POLL_INTERVAL = 1000;
const CHART_HEIGHT = 220;

/** @typedef {import("./answers.js").CurrentUncertainties} CurrentUncertainties */

/** A chart of u of each coefficient versus the recorded time, since the page was opened. */
class UncertaintyChart {
  constructor() {
    this.history = /** @type {CurrentUncertainties[]} */ ([]);
    this.box = make("div", { class: "canvas", role: "img", "aria-label": "Standard uncertainty versus recorded time" });
    this.element = make("figure", { hidden: true }, make("figcaption", {},
      "Standard uncertainty versus recorded time; the curve starts when this page is opened"), this.box);
    /** @type {any} */
    this.chart = null;
    new ResizeObserver(() => {
      const width = this.box.clientWidth;
      if (width && this.chart && this.chart.width !== width) this.chart.setSize({ width, height: CHART_HEIGHT });
    }).observe(this.box);
    globalThis.counterspin.redraws.push(() => this.chart?.redraw(false));
  }

  /** @param {CurrentUncertainties} current */
  add(current) {
    // There is nothing to draw before a coefficient is determined.
    if (!this.history.length && !current.u.some(({ u }) => u)) return;
    this.history = addPoint(this.history, current);
    // A single point is in the table.
    if (this.history.length < 2) return;
    this.element.hidden = false;
    if (!this.chart) this.createChart();
    this.chart.setData(chartColumns(this.history));
  }

  createChart() {
    const { axis, colour } = globalThis.counterspin;
    this.chart = new /** @type {any} */ (globalThis).uPlot({
      width: this.box.clientWidth,
      height: CHART_HEIGHT,
      cursor: { y: false },
      scales: { x: { time: false }, y: { distr: 3, range: (/** @type {any} */ _, /** @type {number} */ low, /** @type {number} */ high) => {
        const steps = stepsCovering(low, high);
        return [steps[0], steps[steps.length - 1]];
      } } },
      axes: [axis("recorded time, min", 34), {
        ...axis("standard uncertainty", 70),
        splits: (/** @type {any} */ _, /** @type {number} */ __, /** @type {number} */ low, /** @type {number} */ high) => stepsCovering(low, high),
        filter: (/** @type {any} */ _, /** @type {number[]} */ steps) => steps,
        values: (/** @type {any} */ _, /** @type {number[]} */ steps) => steps.map(String),
      }],
      series: [{ label: "recorded time, min" }, ...this.history[0].u.map(({ name }, index) =>
        ({ label: name, stroke: () => colour(`--series-${(index % 6) + 1}`), width: 2 }))],
    }, chartColumns(this.history), this.box);
  }
}

/**
 * The steps 1, 2, 5, 10, and so on, that cover a range.
 * @param {number} low
 * @param {number} high
 */
export function stepsCovering(low, high) {
  const steps = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
    for (const digit of [1, 2, 5]) steps.push(Number(`${digit}e${power}`));
  }
  const firstIndex = steps.findLastIndex((step) => step <= low);
  const lastIndex = steps.findIndex((step) => step > low && step >= high);
  return steps.slice(firstIndex, lastIndex + 1);
}

/**
 * The history with a further point, which replaces points at the same or later times.
 * @param {CurrentUncertainties[]} history
 * @param {CurrentUncertainties} current
 */
export function addPoint(history, current) {
  const earlier = history.filter(({ minutes }) => minutes < current.minutes);
  return [...earlier, current];
}

/**
 * Minutes, then u of each coefficient; null instead of 0, because the axis is logarithmic.
 * @param {CurrentUncertainties[]} history
 */
export const chartColumns = (history) => [
  history.map(({ minutes }) => minutes),
  ...history[0].u.map((_, index) => history.map(({ u }) => u[index].u || null)),
];

/**
 * The live view of a campaign.
 * @param {string} name
 */
export async function liveView(name) {
  const campaign = await get("campaign", { name });
  const goal = make("input", { placeholder: "K_II 1e-8 g/g^2", autocomplete: "off", "aria-describedby": "goal-mistake" });
  const container = make("div", {}, make("p", { class: "quiet" }, "Reading the records. This takes a few seconds the first time."));
  const events = make("ul", { class: "quiet", "aria-live": "polite" });
  const command = make("div");
  const chart = new UncertaintyChart();
  const errorBox = make("div", { id: "goal-mistake" });
  let shownHtml = "";
  let goalText = "";
  let isPolling = false;
  /** @returns {Promise<void>} */
  const poll = async () => {
    isPolling = container.isConnected;
    if (!isPolling) return;
    const requestedGoal = goalText;
    try {
      const response = await get("watch", { name, goal: requestedGoal });
      if (requestedGoal !== goalText) return poll();
      if (response.error) {
        isPolling = false;
        container.replaceChildren(warning(response.error));
        return;
      }
      if (response.html && response.html !== shownHtml) {
        shownHtml = response.html;
        if (response.reached) chart.add(response.reached);
        // Escaped by the report's own templates.
        container.innerHTML = response.html;
        container.querySelector("h1")?.remove();
        command.replaceChildren(commandLine(response.command));
        globalThis.counterspin.draw(container);
        response.events.forEach(/** @param {string} event */ (event) => events.prepend(make("li", {}, event)));
      }
      if (response.complete) {
        say("All runs have been recorded.");
        container.append(make("p", {}, make("a", { class: "button", href: campaignAddress(name) }, "Continue to the result")));
        isPolling = false;
        return;
      }
    } catch (error) {
      if (requestedGoal !== goalText) return poll();
      const message = warning(/** @type {Error} */ (error).message);
      if (!requestedGoal || !(error instanceof RequestError) || error.status !== 422) {
        isPolling = false;
        container.replaceChildren(message);
        return;
      }
      // The goal is not valid; the records are monitored without it.
      errorBox.replaceChildren(message);
      goal.setAttribute("aria-invalid", "true");
      if (goalText === requestedGoal) goalText = "";
    }
    setTimeout(poll, POLL_INTERVAL);
  };
  goal.addEventListener("change", () => {
    goalText = goal.value.trim();
    shownHtml = "";
    errorBox.replaceChildren();
    goal.removeAttribute("aria-invalid");
    // Polling that has ended is restarted for another goal.
    if (!isPolling) poll();
  });
  setTimeout(poll);
  return {
    title: `Live: ${campaign.title}`,
    content: [
      make("h1", {}, `Live: ${campaign.title}`), campaignTabs(name, "live", reachedStep(campaign)),
      make("p", { class: "quiet" }, "While your recorder writes records into the campaign folder, this page reads the records every second. "
        + "The ripple is given as a fraction of the rate. The residuals should be about as large as the noise."),
      make("div", { class: "row" }, labelled("Goal (coefficient and standard uncertainty)", goal)), errorBox, chart.element, container, events, command,
    ],
  };
}
