// @ts-check
// What the uncertainty of a result consists of, what it would be, and what would reduce it.

import { campaignAddress, descriptionAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { attempt, make, oneAtATime, say, symbols } from "./dom.js";
import { carryOut } from "./job.js";

/** @typedef {{name: string, words: string, u: number, factor: number, unit: string, share: number}} Source */

/** Sources that are shown, and get a slider: those that count, no more than a glance takes in. */
const MOST = 4;
const LEAST = 0.005;

/**
 * A term in words, with its symbol.
 * @param {{name: string, words: string}} source
 */
export const named = ({ name, words }) => (words ? `${words}, ${name}` : name);

/** @param {number} share */
export const percent = (share) => (share < 0.001 ? "< 0.1 %" : `${Number((100 * share).toPrecision(2))} %`);

/**
 * How well a source is known at a place of its slider, which has tenfold at one.
 * @param {Source} source
 * @param {number} place
 */
export const knownTo = (source, place) => source.u * 10 ** place;

/**
 * @param {Source} source
 * @param {number} u
 */
export const size = ({ factor, unit }, u) => `${Number((u * factor).toPrecision(2))} ${unit}`;

/**
 * The parts of u^2 as one bar, and what each is.
 * @param {Source[]} sources
 */
function partsOf(sources) {
  const rest = Math.max(1 - sources.reduce((sum, { share }) => sum + share, 0), 0);
  const all = [
    ...sources.map((one, place) => ({ label: named(one), share: one.share, colour: `var(--series-${place + 1})` })),
    { label: "noise and all else", share: rest, colour: "var(--muted)" },
  ];
  return [
    make("div", { class: "parts", "aria-hidden": "true" }, ...all.map(({ share, colour }) =>
      make("i", { style: `width: ${100 * share}%; background: ${colour}` }))),
    make("ul", { class: "key" }, ...all.map(({ label, share, colour }) =>
      make("li", {}, make("b", { style: `background: ${colour}` }), ...symbols(`${label}: ${percent(share)}`)))),
  ];
}

/**
 * One accelerometer's uncertainty by source, and sliders for what is known of them.
 * @param {string} result
 * @param {string} accelerometer
 */
async function whatIf(result, accelerometer) {
  const asked = { name: result, accelerometer };
  const first = await send("POST", "what-if", asked);
  /** @type {Source[]} */
  const sources = first.sources.filter((/** @type {Source} */ { share }) => share >= LEAST).slice(0, MOST);
  const shown = make("div");
  const answer = make("p", { class: "answer-line", role: "status" });
  const wrong = make("div");
  /** @type {Record<string, number>} */
  const known = {};

  /** @param {any} told */
  const show = (told) => {
    // The same order, whatever becomes the largest: colours stay with their source.
    const byName = new Map(told.sources.map((/** @type {Source} */ one) => [one.name, one]));
    shown.replaceChildren(...partsOf(sources.map((one) => byName.get(one.name) ?? { ...one, share: 0 })));
    const instead = Object.keys(known).length ? ` instead of ${first.text}` : "";
    answer.replaceChildren(...symbols(`Uncertainty of ${first.symbol} of ${accelerometer}: ${told.text}${instead}`));
  };
  const ask = oneAtATime(async () => show(await send("POST", "what-if", { ...asked, known: { ...known } })), wrong);
  show(first);
  const sliders = sources.map((source, place) => {
    const id = `known-${accelerometer}-${place}`;
    const now = size(source, source.u);
    const words = make("output", { for: id, "aria-live": "off" }, `known to ${now}, as now`);
    const range = make("input", {
      id, type: "range", min: -2, max: 1, step: 0.05, value: 0, "aria-valuetext": words.textContent,
      oninput: () => {
        const u = knownTo(source, Number(range.value));
        if (Number(range.value)) known[source.name] = u;
        else delete known[source.name];
        words.textContent = `known to ${size(source, u)}, ${Number(range.value) ? `now ${now}` : "as now"}`;
        range.setAttribute("aria-valuetext", words.textContent);
        ask();
      },
    });
    return make("div", {}, make("label", { for: id }, ...symbols(named(source))), range, words);
  });
  /** @type {Node[]} */
  const content = [answer, shown];
  if (sliders.length) {
    content.push(make("details", { open: true },
      make("summary", {}, "What if one of these were known better?"),
      make("p", { class: "quiet" }, "Move left for better known, right for less well known. Computed by updating the fit, with the noise as estimated."),
      make("div", { class: "sliders" }, ...sliders)), wrong);
  }
  return make("div", { class: "card" }, ...content);
}

/**
 * What the uncertainties of a result consist of; nothing of one that does not say it.
 * @param {string} result
 * @param {string[]} accelerometers
 */
export async function consistsOf(result, accelerometers) {
  const parts = await Promise.all(accelerometers.map((one) => whatIf(result, one).catch(() => null)));
  const there = parts.filter((part) => part !== null);
  return there.length
    ? [make("section", { class: "consists" }, make("h2", {}, "What the uncertainty consists of"), ...there)] : [];
}

/**
 * The cheapest ways to a smaller uncertainty; each click prepares a copy of the campaign.
 * @param {string} name
 * @param {string} result
 */
export async function waysPart(name, result) {
  const told = await get("ways", { name, result }).catch(() => null);
  if (!told?.ways.length) return null;
  const place = make("div");
  const again = () => waysPart(name, result).then((part) => { if (part) box.replaceWith(part); });

  /**
   * @param {string} accelerometer
   * @param {"state" | "runs"} way
   * @param {string} then
   */
  const prepare = (accelerometer, way, then) => () => attempt(place, async () => {
    const made = await send("POST", "way", { name, result, accelerometer, way });
    say(then);
    location.hash = made.key ? descriptionAddress(made.name, `f-${made.key}`) : campaignAddress(made.name);
  });
  const lines = told.ways.flatMap((/** @type {any} */ { accelerometer, stated, runs }) => {
    const of = told.ways.length > 1 ? ` of ${accelerometer}` : "";
    const found = runs ? [make("li", {},
      ...symbols(`Add ${runs.count} run${runs.count === 1 ? "" : "s"} turned ${runs.attitude} (${runs.minutes} min of records): ` +
        `the uncertainty of ${stated.symbol}${of} becomes ${runs.left} instead of ${runs.now}. `),
      make("button", { type: "button",
        onclick: prepare(accelerometer, "runs", "A copy of the campaign has these runs; record them, then calibrate it.") }, "Prepare these runs"))]
      : told.searched ? [make("li", {}, `No run in another attitude would improve ${accelerometer}.`)] : [];
    return [make("li", {},
      ...symbols(`Measure or state the ${named({ name: stated.source, words: stated.words })}, to ${stated.known}: ` +
        `the uncertainty of ${stated.symbol}${of} becomes ${stated.left} instead of ${stated.now}. `),
      make("button", { type: "button",
        onclick: prepare(accelerometer, "state", "A copy of the campaign states it: replace the value by yours.") }, "Prepare the value")),
    ...found];
  });
  const box = make("section", { class: "ways" }, make("h2", {}, "Ways to a smaller uncertainty"), make("ul", {}, ...lines));
  if (!told.searched && told.has_runs) {
    box.append(make("button", {
      type: "button",
      onclick: carryOut(place, () => send("POST", "ways", { name }), again),
    }, "Look for runs in another attitude"));
  }
  box.append(place);
  return box;
}
