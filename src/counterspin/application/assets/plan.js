// @ts-check
// Plans: limits as sliders, and the best plan's uncertainty while they move.

import { get, send } from "./api.js";
import { commandLine, labelled, make, oneAtATime, symbols, warning } from "./dom.js";
import { campaignAddress } from "./addresses.js";
import { follow } from "./job.js";
import { fill } from "./result.js";

/** The list of plans. */
export async function plansView() {
  const folder = await get("folder");
  return {
    title: "Plans",
    content: [
      make("h1", {}, "Plans"),
      make("p", { class: "quiet" }, "A plan chooses the runs' rates, lengths and attitudes that lead to the smallest uncertainty ",
        "within limits of time and machine, or to a wanted one in the shortest time."),
      folder.plans.length
        ? make("ul", { class: "cards" }, ...folder.plans.map(/** @param {string} name */ (name) =>
          make("li", { class: "card" }, make("h2", {},
            make("a", { href: `#/plan/${encodeURIComponent(name)}` }, name)))))
        : make("p", {}, "There is no plan in this folder yet."),
      ...(folder.plans.includes("PLAN.toml") ? [] : [make("button", {
        type: "button",
        class: folder.plans.length ? null : "main",
        onclick: async () => {
          await send("POST", "plan", { name: "PLAN.toml" });
          location.hash = "#/plan/PLAN.toml";
        },
      }, "Write an example, PLAN.toml")]),
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
 * The page of a plan.
 * @param {string} name
 */
export async function planView(name) {
  const plan = await get("plan", { name });
  const answer = make("div", { "aria-live": "polite" });
  const runs = make("div", { class: "scroll", role: "region", tabindex: "0", "aria-label": "Runs" });
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
          : `${short(line.u / first.u[i].u)} times that with the limits of the file`))),
    make("p", {}, `${told.runs.length} runs in ${duration(told.time)}`));
    runs.replaceChildren(make("table", {},
      make("thead", {}, make("tr", {}, ...["Run", "Rate, rad/s", "Duration", "Attitude"].map((words) =>
        make("th", { scope: "col" }, words)))),
      make("tbody", {}, ...told.runs.map(/** @type {(run: any, i: number) => Node} */ (run, i) =>
        make("tr", {}, make("th", { scope: "row" }, String(i + 1)),
          make("td", { class: "right" }, short(run.rate).replace("-", "−")),
          make("td", { class: "right" }, duration(run.seconds)),
          make("td", {}, run.attitude))))));
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
    const words = make("output", { for: id, "aria-live": "off" }, `${short(limit.value)} ${limit.unit}`);
    if (limit.key === "total_time") return timeField(id, limit, (seconds) => {
      moved[limit.key] = seconds;
      ask();
    });
    const range = make("input", {
      id, type: "range", min: limit.low, max: limit.high, step: limit.whole ? 1 : "any", value: limit.value,
      "aria-valuetext": words.textContent,
      oninput: () => {
        moved[limit.key] = Number(range.value);
        words.textContent = `${short(Number(range.value))} ${limit.unit}`;
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
    onsubmit: async (/** @type {Event} */ event) => {
      event.preventDefault();
      try {
        const job = await send("POST", "planned", { name, moved, folder: folder.value });
        follow(job, written, () => { location.hash = campaignAddress(job.output); });
      } catch (error) {
        written.replaceChildren(warning(/** @type {Error} */ (error).message));
      }
    },
  }, labelled("Folder of the planned campaign", folder),
  make("button", { class: "main" }, "Write these limits and the campaign"));
  const whole = make("div");
  const forecast = make("details", {
    ontoggle: () => { if (forecast.open && !whole.childNodes.length) fill(whole, "plan", [name]); },
  }, make("summary", {}, "The complete plan, with its forecast"), whole);
  ask();
  return {
    title: plan.title,
    content: [
      make("h1", {}, plan.title), make("p", { class: "quiet" }, name),
      make("div", { class: "sliders" }, ...sliders), wrong, answer, runs, forecast,
      make("h2", {}, "Make it"), form, written, commandLine(plan.command),
    ],
  };
}
