// @ts-check
// Plans: limits as sliders, and the best plan's uncertainty while they move.

import { get, send } from "./api.js";
import { attempt, commandLine, labelled, make, oneAtATime, submitting, symbols } from "./dom.js";
import { campaignAddress } from "./addresses.js";
import { editorOf } from "./editor.js";
import { carryOut } from "./job.js";
import { fill } from "./result.js";

/** @param {string} name */
const planAddress = (name) => `#/plan/${encodeURIComponent(name)}`;

/** The list of plans. */
export async function plansView() {
  const folder = await get("folder");
  const wrong = make("div");
  const name = make("input", { required: true, autocomplete: "off", value: "PLAN.toml" });
  const example = make("select", {},
    make("option", { value: "records" }, "Records of a double turntable"),
    make("option", { value: "poses" }, "Poses of three accelerometers"));
  const form = make("form", {
    class: "row",
    onsubmit: submitting(wrong, async () => {
      await send("POST", "plan", { name: name.value.trim(), example: example.value });
      location.hash = planAddress(name.value.trim());
    }),
  }, labelled("File of the example", name), labelled("What is planned", example), make("button", {}, "Write an example"));
  return {
    title: "Plans",
    content: [
      make("h1", {}, "Plans"),
      make("p", { class: "quiet" }, "A plan chooses the runs' rates, lengths and attitudes that lead to the smallest uncertainty ",
        "within the limits of time and machine, or to a target uncertainty in the shortest time. A plan of readings chooses ",
        "positions, rates or poses in the same way."),
      folder.plans.length
        ? make("ul", { class: "cards" }, ...folder.plans.map(/** @param {{name: string, title: string}} plan */ ({ name, title }) =>
          make("li", { class: "card" }, make("h2", {}, make("a", { href: planAddress(name) }, title || name)),
            title ? make("p", { class: "quiet" }, name) : null)))
        : make("p", {}, "There is no plan in this folder yet."),
      make("h2", {}, "Begin a plan"), form, wrong,
    ],
  };
}

/** @param {number} value */
const short = (value) => Number(value.toPrecision(4)).toString();

/** @param {number} seconds */
const duration = (seconds) =>
  seconds >= 2 * 86400 ? `${short(seconds / 86400)} days` : seconds >= 7200 ? `${short(seconds / 3600)} h` : seconds >= 120 ? `${short(seconds / 60)} min` : `${short(seconds)} s`;

/** Unit of time -> seconds. */
const UNITS = { min: 60, h: 3600, days: 86400 };

/**
 * A time as number and unit, in the largest unit of which there is one.
 * @param {number} seconds
 * @returns {[number, keyof typeof UNITS]}
 */
export function inUnit(seconds) {
  const unit = seconds >= UNITS.days ? "days" : seconds >= UNITS.h ? "h" : "min";
  return [Number((seconds / UNITS[unit]).toPrecision(4)), unit];
}

/**
 * The time of a plan: a number to type, since a slider ends too early for a day.
 * @param {string} id
 * @param {any} limit
 * @param {(seconds: number) => void} moved
 */
function timeField(id, limit, moved) {
  const [value, first] = inUnit(limit.value);
  const number = make("input", { id, type: "number", min: 0, step: "any", value, required: true });
  const unit = make("select", { "aria-label": `Unit of ${limit.words}` },
    ...Object.keys(UNITS).map((one) => make("option", { value: one, selected: one === first }, one)));
  const wrong = make("p", { class: "wrong", role: "alert" });
  const change = () => {
    const seconds = Number(number.value) * UNITS[/** @type {keyof typeof UNITS} */ (unit.value)];
    const good = seconds >= limit.low && seconds <= limit.high;
    wrong.textContent = good ? "" : `From ${duration(limit.low)} to ${duration(limit.high)}.`;
    number.setAttribute("aria-invalid", String(!good));
    if (good) moved(seconds);
  };
  number.addEventListener("change", change);
  unit.addEventListener("change", change);
  return make("div", {}, make("label", { for: id }, limit.words), make("div", { class: "quantity" }, number, unit), wrong);
}

/**
 * A table whose cells are texts; the first of each row names it.
 * @param {string[]} heads
 * @param {string[][]} rows
 * @param {boolean[]} right whether a column's cells stand at the right
 */
const table = (heads, rows, right) => make("table", {},
  make("thead", {}, make("tr", {}, ...heads.map((words, i) => make("th", { scope: "col", class: right[i] ? "right" : null }, words)))),
  make("tbody", {}, ...rows.map(([first, ...others]) => make("tr", {}, make("th", { scope: "row" }, first),
    ...others.map((cell, i) => make("td", { class: right[i + 1] ? "right" : null }, cell))))));

/**
 * The runs of a plan, with rates in the unit of its file.
 * @param {{rate: number, seconds: number, attitude: string}[]} runs
 * @param {{unit: string, factor: number}} rate
 */
const runTable = (runs, rate) => table(["Run", `Rate, ${rate.unit}`, "Duration", "Attitude"],
  runs.map((run, i) => [String(i + 1), short(run.rate / rate.factor).replace("-", "−"), duration(run.seconds), run.attitude]),
  [false, true, true, false]);

/**
 * The readings of a plan, each with how often it is taken.
 * @param {{name: string, number: number}[]} readings
 */
const readingTable = (readings) => table(["Reading", "How often"],
  readings.map(({ name, number }) => [name.replaceAll("-", "−"), String(number)]), [false, true]);

/**
 * How many runs or readings a plan has, and how long they take.
 * @param {any} told
 */
const extent = (told) => told.runs ? `${told.runs.length} runs in ${duration(told.time)}`
  : `${told.readings.reduce((/** @type {number} */ sum, /** @type {any} */ { number }) => sum + number, 0)} readings`
    + (told.time ? ` in ${duration(told.time)}` : "");

/**
 * The page of a plan.
 * @param {string} name
 */
export async function planView(name) {
  const plan = await get("plan", { name });
  const answer = make("div", { "aria-live": "polite" });
  const runs = make("div", { class: "scroll", role: "region", tabindex: "0", "aria-label": "What is planned" });
  const wrong = make("div");
  /** @type {Record<string, number>} */
  const moved = {};
  /** @type {any} */
  let first = null;

  /** @param {any} told */
  const show = (told) => {
    first ??= told;
    answer.className = "answers";
    answer.replaceChildren(...told.u.map(/** @type {(line: any, i: number) => Node} */ (line, i) =>
      make("p", { class: "answer" },
        make("strong", {}, ...symbols(`Uncertainty of ${line.name}: ${line.text}`)), " ",
        make("span", {}, line.text === first.u[i].text ? "as with the limits of the file"
          : `${short(line.u / first.u[i].u)} times the value with the limits of the file`))),
    make("p", {}, extent(told)));
    runs.replaceChildren(told.runs ? runTable(told.runs, plan.rate) : readingTable(told.readings));
  };
  /**
   * Ask until there is an answer; whoever leaves the page, or stops, asks no more.
   * @param {Record<string, number>} wanted
   */
  const search = async (wanted) => {
    let stopped = false;
    const stop = make("button", {
      type: "button",
      onclick: () => {
        stopped = true;
        send("DELETE", "plan-try", { name });
      },
    }, "Stop");
    const begun = Date.now();
    const seconds = make("span");
    for (let asked = 0; ; asked += 1) {
      const told = await send("POST", "plan-try", { name, moved: wanted });
      if (!told.busy) return told;
      if (stopped || (asked > 4 && !wrong.isConnected)) throw new Error("The search was stopped.");
      if (asked === 0) wrong.replaceChildren(make("div", { class: "job" }, make("progress", { "aria-label": "Progress of the search" }),
        make("p", { class: "quiet" }, "Searching for the best plan", seconds), stop));
      seconds.textContent = `, ${Math.round((Date.now() - begun) / 1000)} s`;
    }
  };
  const ask = oneAtATime(async () => show(await search({ ...moved })), wrong);
  const sliders = plan.limits.map(/** @param {any} limit */ (limit) => {
    const id = `limit-${limit.key}`;
    // The slider itself says its value.
    const shown = (/** @type {number} */ value) => `${short(value)} ${limit.unit}`.trimEnd();
    const words = make("output", { for: id, "aria-live": "off" }, shown(limit.value / limit.factor));
    if (limit.key === "total_time") return timeField(id, limit, (seconds) => {
      moved[limit.key] = seconds;
      ask();
    });
    const range = make("input", {
      id, type: "range", min: limit.low / limit.factor, max: limit.high / limit.factor, step: limit.whole ? 1 : "any",
      value: limit.value / limit.factor,
      "aria-valuetext": words.textContent,
      oninput: () => {
        moved[limit.key] = Number(range.value) * limit.factor;
        words.textContent = shown(Number(range.value));
        range.setAttribute("aria-valuetext", words.textContent);
        ask();
      },
    });
    return make("div", {}, make("label", { for: id }, limit.words), range, words);
  });
  const folder = make("input", { required: true, autocomplete: "off", placeholder: "planned" });
  const written = make("div");
  const form = make("form", {
    class: "row",
    onsubmit: carryOut(written, () => send("POST", "planned", { name, moved, folder: folder.value }),
      (job) => { location.hash = campaignAddress(job.output); }),
  }, labelled("Folder of the planned campaign", folder),
  make("button", { class: "main" }, "Write these limits and the campaign"));
  const whole = make("div");
  const forecast = make("details", {
    ontoggle: () => { if (forecast.open && !whole.childNodes.length) fill(whole, "plan", [name]); },
  }, make("summary", {}, "The complete plan, with its forecast"), whole);
  const edited = make("div");
  const file = make("details", {
    ontoggle: () => {
      if (!file.open || edited.childNodes.length) return;
      attempt(edited, async () => {
        // What is planned is another plan then.
        const saved = () => dispatchEvent(new HashChangeEvent("hashchange"));
        edited.replaceChildren(editorOf(await get("plan-text", { name }), { saved }).element);
      });
    },
  }, make("summary", {}, "The plan's file: goal, limits and what is known"), edited);
  ask();
  return {
    title: plan.title,
    content: [
      make("h1", {}, plan.title), make("p", { class: "quiet" }, name),
      make("div", { class: "sliders" }, ...sliders), wrong, answer, runs, forecast, file,
      make("h2", {}, "Make it"), form, written, commandLine(plan.command),
    ],
  };
}
