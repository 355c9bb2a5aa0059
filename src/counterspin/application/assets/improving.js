// @ts-check
// What the uncertainty of a result would be with better inputs, and what would reduce it.

import { campaignAddress, descriptionAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { attempt, make, oneAtATime, say, symbols, working } from "./dom.js";
import { carryOut } from "./job.js";

/** @typedef {import("./answers.js").WhatIfSource} Source */

/** Sources that are shown, and get a slider: those that count, no more than a glance takes in. */
const MOST = 4;
const LEAST = 0.005;

/**
 * A term in words, with its symbol.
 * @param {{name: string, words: string}} source
 */
export const named = ({ name, words }) => (words ? `${words}, ${name}` : name);

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
 * Add sliders to the budget of one accelerometer: what u would be if its sources were known better.
 * @param {HTMLElement} part
 * @param {string} result
 * @param {string} accelerometer
 */
export async function addSliders(part, result, accelerometer) {
  const asked = { name: result, accelerometer };
  const first = await send("POST", "what-if", asked).catch(() => null);
  if (!first) return;
  const label = `Table: Uncertainty budget of ${first.symbol}, ${accelerometer}`;
  const box = [...part.querySelectorAll(".scroll")].find((one) => one.getAttribute("aria-label") === label);
  if (!box) return;
  /** @type {Source[]} */
  const sources = first.sources.filter((/** @type {Source} */ { share }) => share >= LEAST).slice(0, MOST);
  const answer = make("p", { class: "answer-line", role: "status" }, ...symbols(`u of ${first.symbol}: ${first.text}`));
  const wrong = make("div");
  /** @type {Record<string, number>} */
  const known = {};
  const ask = oneAtATime(async () => {
    const told = await send("POST", "what-if", { ...asked, known: { ...known } });
    const instead = Object.keys(known).length ? ` (currently ${first.text})` : "";
    answer.replaceChildren(...symbols(`u of ${first.symbol}: ${told.text}${instead}`));
  }, wrong);
  const rows = /** @type {HTMLTableRowElement[]} */ ([...box.querySelectorAll("tr")]);
  rows[0].append(make("th", { scope: "col", class: "control" }, "Assumed standard uncertainty"));
  const cells = rows.slice(1).map((row) => {
    const cell = make("td", { class: "control" });
    row.append(cell);
    return { name: row.cells[0].textContent, cell };
  });
  sources.forEach((source, place) => {
    const cell = cells.find(({ name }) => name === source.name)?.cell;
    if (!cell) return;
    const id = `known-${accelerometer}-${place}`;
    const words = make("output", { for: id, "aria-live": "off" }, size(source, source.u));
    const range = make("input", {
      id, type: "range", min: -2, max: 1, step: 0.05, value: 0,
      "aria-label": named(source), "aria-valuetext": `${words.textContent}, current value`,
      oninput: () => {
        const u = knownTo(source, Number(range.value));
        if (Number(range.value)) known[source.name] = u;
        else delete known[source.name];
        words.textContent = size(source, u);
        range.setAttribute("aria-valuetext", `${words.textContent}${Number(range.value) ? "" : ", current value"}`);
        ask();
      },
    });
    cell.append(range, words);
  });
  box.before(answer);
  box.after(wrong);
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
    place.replaceChildren(working("Preparing a copy of the campaign"));
    const made = await send("POST", "way", { name, result, accelerometer, way });
    say(then);
    if (place.isConnected) location.hash = made.key ? descriptionAddress(made.name, `f-${made.key}`) : campaignAddress(made.name);
  });
  const lines = told.ways.flatMap(({ accelerometer, stated, runs }) => {
    const of = told.ways.length > 1 ? ` of ${accelerometer}` : "";
    const found = runs ? [make("li", {},
      ...symbols(`Add ${runs.count} run${runs.count === 1 ? "" : "s"} with attitude ${runs.attitude} (${runs.minutes} min of records): ` +
        `the uncertainty of ${stated.symbol}${of} would fall from ${runs.now} to ${runs.left}. `),
      make("button", { type: "button",
        onclick: prepare(accelerometer, "runs", "These runs were added to a copy of the campaign. Record them, then calibrate the copy.") }, "Prepare a copy with these runs"))]
      : told.searched ? [make("li", {}, `No run at another attitude would reduce the uncertainty of ${stated.symbol}${of}.`)] : [];
    return [make("li", {},
      ...symbols(`Measure or specify the ${named({ name: stated.source, words: stated.words })}, with a standard uncertainty of ${stated.known}: ` +
        `the uncertainty of ${stated.symbol}${of} would fall from ${stated.now} to ${stated.left}. `),
      make("button", { type: "button",
        onclick: prepare(accelerometer, "state", "The copy of the campaign contains the assumed value. " +
          "Replace it with your measured value.") }, "Prepare a copy with this value")),
    ...found];
  });
  const box = make("section", { class: "ways" }, make("h2", {}, "How to reduce the uncertainty"), make("ul", {}, ...lines));
  if (!told.searched && told.has_runs) {
    box.append(make("button", {
      type: "button",
      onclick: carryOut(place, () => send("POST", "ways", { name }), again),
    }, "Find additional runs at another attitude"));
  }
  box.append(place);
  return box;
}
