// @ts-check
// Plans: limits as sliders, and the best plan within them on request.

import { get, send } from "./api.js";
import { attempt, commandLine, labelled, make, submitting, working } from "./dom.js";
import { campaignAddress } from "./addresses.js";
import { editorOf } from "./editor.js";
import { carryOut, follow } from "./job.js";

/** @param {string} name */
const planAddress = (name) => `#/plan/${encodeURIComponent(name)}`;

/** The list of plans. */
export async function plansView() {
  const folder = await get("folder");
  const wrong = make("div");
  const name = make("input", { required: true, autocomplete: "off", value: "PLAN.toml" });
  const example = make("select", {},
    make("option", { value: "records" }, "Double-turntable records"),
    make("option", { value: "poses" }, "Poses for three accelerometers"));
  const form = make("form", {
    class: "row",
    onsubmit: submitting(wrong, async () => {
      await send("POST", "plan", { name: name.value.trim(), example: example.value });
      location.hash = planAddress(name.value.trim());
    }),
  }, labelled("Example file", name), labelled("Plan type", example), make("button", {}, "Write example"));
  return {
    title: "Plans",
    content: [
      make("h1", {}, "Plans"),
      make("p", { class: "quiet" }, "A plan selects the rates, durations and attitudes of the runs. It minimises the uncertainty within the limits of ",
        "time and machine, or the time needed to reach a target uncertainty. A plan for readings selects ",
        "positions, rates or poses in the same way."),
      folder.plans.length
        ? make("ul", { class: "cards" }, ...folder.plans.map(/** @param {{name: string, title: string}} plan */ ({ name, title }) =>
          make("li", { class: "card" }, make("h2", {}, make("a", { href: planAddress(name) }, title || name)),
            title ? make("p", { class: "quiet" }, name) : null)))
        : make("p", {}, "This folder contains no plans yet."),
      make("h2", {}, "New plan"), form, wrong,
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
 * @param {import("./answers.js").Limit} limit
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
    wrong.textContent = good ? "" : `Enter a time from ${duration(limit.low)} to ${duration(limit.high)}.`;
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
  /** @type {Record<string, number>} */
  const moved = {};
  const planned = make("div");
  const state = make("p", { class: "quiet", role: "status" });

  /**
   * Show the best plan within limits, after the job that searches for it.
   * @param {Record<string, number>} limits
   * @returns {Promise<void>}
   */
  const show = (limits) => {
    // In a box of its own, so that the late answer of an earlier search is shown nowhere.
    const box = make("div", {}, working("Planning"));
    planned.replaceChildren(box);
    return attempt(box, async () => {
      const told = await send("POST", "plan-page", { name, moved: limits });
      if (told.job) return follow(told.job, box, () => show(limits));
      const part = make("div", { class: "report" });
      // Escaped by the report's own templates.
      part.innerHTML = told.html;
      part.querySelector("h1")?.remove();
      box.replaceChildren(part);
    });
  };
  /**
   * Set a limit for the next search.
   * @param {string} key
   * @param {number} value in SI
   */
  const move = (key, value) => {
    moved[key] = value;
    if (planned.childElementCount) state.textContent = "The limits have changed since this plan was calculated. Calculate the plan again.";
  };
  const sliders = plan.limits.map((limit) => {
    const id = `limit-${limit.key}`;
    // The slider itself says its value.
    const shown = (/** @type {number} */ value) => `${short(value)} ${limit.unit}`.trimEnd();
    const words = make("output", { for: id, "aria-live": "off" }, shown(limit.value / limit.factor));
    if (limit.key === "total_time") return timeField(id, limit, (seconds) => move(limit.key, seconds));
    const range = make("input", {
      id, type: "range", min: limit.low / limit.factor, max: limit.high / limit.factor, step: limit.whole ? 1 : "any",
      value: limit.value / limit.factor,
      "aria-valuetext": words.textContent,
      oninput: () => {
        move(limit.key, Number(range.value) * limit.factor);
        words.textContent = shown(Number(range.value));
        range.setAttribute("aria-valuetext", words.textContent);
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
  }, labelled("Folder for the planned campaign", folder),
  make("button", {}, "Save limits and create campaign"));
  const search = make("form", {
    onsubmit: submitting(planned, () => {
      state.textContent = "";
      return show({ ...moved });
    }),
  }, make("div", { class: "sliders" }, ...sliders), make("button", { class: "main" }, "Calculate plan"));
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
  }, make("summary", {}, "Plan file: goal, limits and known values"), edited);
  return {
    title: plan.title,
    content: [
      make("h1", {}, plan.title), make("p", { class: "quiet" }, name),
      search, state, planned, file,
      make("h2", {}, "Planned campaign"), form, written, commandLine(plan.command),
    ],
  };
}
