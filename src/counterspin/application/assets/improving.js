// @ts-check
// The uncertainty of a result with better inputs, and ways to reduce the uncertainty.

import { campaignAddress, descriptionAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { attempt, make, oneAtATime, say, setSymbols, working } from "./dom.js";
import { jobStarter } from "./job.js";

/** @typedef {import("./answers.js").WhatIfSource} Source */

/** Largest number of sources with a slider, and their smallest share of the variance. */
const MAX_SOURCES = 4;
const MIN_SHARE = 0.005;

/**
 * The description of a term, with its symbol.
 * @param {{name: string, words: string}} source
 */
export const termLabel = ({ name, words }) => (words ? `${words}, ${name}` : name);

/**
 * The standard uncertainty of a source at a position of its slider, in decades.
 * @param {Source} source
 * @param {number} exponent
 */
export const scaledUncertainty = (source, exponent) => source.u * 10 ** exponent;

/**
 * @param {Source} source
 * @param {number} u
 */
export const uncertaintyText = ({ factor, unit }, u) => `${Number((u * factor).toPrecision(2))} ${unit}`;

/**
 * Add sliders to the uncertainty budget of an accelerometer, which change the uncertainties of the sources.
 * @param {HTMLElement} reportPart
 * @param {string} result
 * @param {string} accelerometer
 */
export async function addSliders(reportPart, result, accelerometer) {
  const request = { name: result, accelerometer };
  const current = await send("POST", "what-if", request).catch(() => null);
  if (!current) return;
  const label = `Table: Uncertainty budget of ${current.symbol}, ${accelerometer}`;
  const box = [...reportPart.querySelectorAll(".scroll")].find((element) => element.getAttribute("aria-label") === label);
  if (!box) return;
  /** @type {Source[]} */
  const sources = current.sources.filter((/** @type {Source} */ { share }) => share >= MIN_SHARE).slice(0, MAX_SOURCES);
  const answerLine = make("p", { class: "answer-line", role: "status" }, ...setSymbols(`u of ${current.symbol}: ${current.text}`));
  const errorBox = make("div");
  /** @type {Record<string, number>} */
  const known = {};
  const update = oneAtATime(async () => {
    const response = await send("POST", "what-if", { ...request, known: { ...known } });
    const currentText = Object.keys(known).length ? ` (currently ${current.text})` : "";
    answerLine.replaceChildren(...setSymbols(`u of ${current.symbol}: ${response.text}${currentText}`));
  }, errorBox);
  const rows = /** @type {HTMLTableRowElement[]} */ ([...box.querySelectorAll("tr")]);
  rows[0].append(make("th", { scope: "col", class: "control" }, "Assumed standard uncertainty"));
  const cells = rows.slice(1).map((row) => {
    const cell = make("td", { class: "control" });
    row.append(cell);
    return { name: row.cells[0].textContent, cell };
  });
  sources.forEach((source, index) => {
    const cell = cells.find(({ name }) => name === source.name)?.cell;
    if (!cell) return;
    const id = `known-${accelerometer}-${index}`;
    const output = make("output", { for: id, "aria-live": "off" }, uncertaintyText(source, source.u));
    const range = make("input", {
      id, type: "range", min: -2, max: 1, step: 0.05, value: 0,
      "aria-label": termLabel(source), "aria-valuetext": `${output.textContent}, current value`,
      oninput: () => {
        const u = scaledUncertainty(source, Number(range.value));
        if (Number(range.value)) known[source.name] = u;
        else delete known[source.name];
        output.textContent = uncertaintyText(source, u);
        range.setAttribute("aria-valuetext", `${output.textContent}${Number(range.value) ? "" : ", current value"}`);
        update();
      },
    });
    cell.append(range, output);
  });
  box.before(answerLine);
  box.after(errorBox);
}

/**
 * The most effective ways to reduce the uncertainty; each button prepares a copy of the campaign.
 * @param {string} name
 * @param {string} result
 */
export async function improvementsPart(name, result) {
  const response = await get("ways", { name, result }).catch(() => null);
  if (!response?.ways.length) return null;
  const container = make("div");
  const refresh = () => improvementsPart(name, result).then((part) => { if (part) box.replaceWith(part); });

  /**
   * @param {string} accelerometer
   * @param {"state" | "runs"} way
   * @param {string} message
   */
  const prepare = (accelerometer, way, message) => () => attempt(container, async () => {
    container.replaceChildren(working("Preparing a copy of the campaign"));
    const copy = await send("POST", "way", { name, result, accelerometer, way });
    say(message);
    if (container.isConnected) location.hash = copy.key ? descriptionAddress(copy.name, `f-${copy.key}`) : campaignAddress(copy.name);
  });
  const lines = response.ways.flatMap(({ accelerometer, stated, runs }) => {
    const ownerText = response.ways.length > 1 ? ` of ${accelerometer}` : "";
    const runLines = runs ? [make("li", {},
      ...setSymbols(`Add ${runs.count} run${runs.count === 1 ? "" : "s"} with attitude ${runs.attitude} (${runs.minutes} min of records): ` +
        `the uncertainty of ${stated.symbol}${ownerText} would fall from ${runs.current_u} to ${runs.remaining_u}. `),
      make("button", { type: "button",
        onclick: prepare(accelerometer, "runs", "These runs were added to a copy of the campaign. Record them, then run the calibration in the copy.") }, "Prepare a copy with these runs"))]
      : response.searched ? [make("li", {}, `No run at another attitude would reduce the uncertainty of ${stated.symbol}${ownerText}.`)] : [];
    return [make("li", {},
      ...setSymbols(`Measure or specify the ${termLabel({ name: stated.source, words: stated.words })}, with a standard uncertainty of ${stated.assumed_u}: ` +
        `the uncertainty of ${stated.symbol}${ownerText} would fall from ${stated.current_u} to ${stated.remaining_u}. `),
      make("button", { type: "button",
        onclick: prepare(accelerometer, "state", "The copy of the campaign contains the assumed value. " +
          "Replace it with your measured value.") }, "Prepare a copy with this value")),
    ...runLines];
  });
  const box = make("section", { class: "ways" }, make("h2", {}, "How to reduce the uncertainty"), make("ul", {}, ...lines));
  if (!response.searched && response.has_runs) {
    box.append(make("button", {
      type: "button",
      onclick: jobStarter(container, () => send("POST", "ways", { name }), refresh),
    }, "Find additional runs at another attitude"));
  }
  box.append(container);
  return box;
}
