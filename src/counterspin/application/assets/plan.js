// @ts-check
// Plans: limits as sliders, and the optimal plan within the limits.

import { get, send } from "./api.js";
import { attempt, commandLine, labelled, make, submitHandler, working } from "./dom.js";
import { campaignAddress } from "./addresses.js";
import { makeEditor } from "./editor.js";
import { follow, isActive, jobStarter } from "./job.js";

/** @param {string} name */
const planAddress = (name) => `#/plan/${encodeURIComponent(name)}`;

/** The list of plans. */
export async function plansView() {
  const folder = await get("folder");
  const errorBox = make("div");
  const name = make("input", { required: true, autocomplete: "off", value: "PLAN.toml" });
  const example = make("select", {},
    make("option", { value: "records" }, "Double-turntable records"),
    make("option", { value: "poses" }, "Poses for three accelerometers"));
  const form = make("form", {
    class: "row",
    onsubmit: submitHandler(errorBox, async () => {
      const response = await send("POST", "plan", { name: name.value.trim(), example: example.value });
      location.hash = planAddress(response.name);
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
      make("h2", {}, "New plan"), form, errorBox,
    ],
  };
}

/** @param {number} value */
const formatShort = (value) => Number(value.toPrecision(4)).toString();

/** @param {number} seconds */
const formatDuration = (seconds) =>
  seconds >= 2 * 86400 ? `${formatShort(seconds / 86400)} days` : seconds >= 7200 ? `${formatShort(seconds / 3600)} h` : seconds >= 120 ? `${formatShort(seconds / 60)} min` : `${formatShort(seconds)} s`;

/** Unit of time -> seconds. */
const SECONDS_PER_UNIT = { min: 60, h: 3600, days: 86400 };

/**
 * A time as number and unit, in the largest unit in which the number is at least 1.
 * @param {number} seconds
 * @returns {[number, keyof typeof SECONDS_PER_UNIT]}
 */
export function splitTime(seconds) {
  const unit = seconds >= SECONDS_PER_UNIT.days ? "days" : seconds >= SECONDS_PER_UNIT.h ? "h" : "min";
  return [Number((seconds / SECONDS_PER_UNIT[unit]).toPrecision(4)), unit];
}

/**
 * The time of a plan as a number, because the range of a slider would be too small.
 * @param {string} id
 * @param {import("./answers.js").Limit} limit
 * @param {(seconds: number) => void} onChange
 */
function timeField(id, limit, onChange) {
  const [value, initialUnit] = splitTime(limit.value);
  const numberInput = make("input", { id, type: "number", min: 0, step: "any", value, required: true });
  const unitSelect = make("select", { "aria-label": `Unit of ${limit.words}` },
    ...Object.keys(SECONDS_PER_UNIT).map((unitName) => make("option", { value: unitName, selected: unitName === initialUnit }, unitName)));
  const errorText = make("p", { class: "wrong", role: "alert" });
  const change = () => {
    const seconds = Number(numberInput.value) * SECONDS_PER_UNIT[/** @type {keyof typeof SECONDS_PER_UNIT} */ (unitSelect.value)];
    const isValid = seconds >= limit.low && seconds <= limit.high;
    errorText.textContent = isValid ? "" : `Enter a time from ${formatDuration(limit.low)} to ${formatDuration(limit.high)}.`;
    numberInput.setAttribute("aria-invalid", String(!isValid));
    if (isValid) onChange(seconds);
  };
  numberInput.addEventListener("change", change);
  unitSelect.addEventListener("change", change);
  return make("div", {}, make("label", { for: id }, limit.words), make("div", { class: "quantity" }, numberInput, unitSelect), errorText);
}

/**
 * The page of a plan.
 * @param {string} name
 */
export async function planView(name) {
  const [plan, jobs] = await Promise.all([get("plan", { name }), get("jobs")]);
  const limitsKey = `counterspin-limits-${name}`;
  // The limits of a search that this window started before a reload.
  const isSearching = jobs.some((job) => job.kind === "plan" && job.campaign === name && isActive(job));
  const searchedLimits = isSearching ? sessionStorage.getItem(limitsKey) : null;
  /** @type {Record<string, number>} */
  const movedLimits = JSON.parse(searchedLimits ?? "{}");
  for (const limit of plan.limits) limit.value = movedLimits[limit.key] ?? limit.value;
  const planContainer = make("div");
  const status = make("p", { class: "quiet", role: "status" });

  /**
   * Show the optimal plan within limits, after its job.
   * @param {Record<string, number>} limits
   * @returns {Promise<void>}
   */
  const show = (limits) => {
    // In a separate box, so that a late response of an earlier search is not shown.
    const box = make("div", {}, working("Planning"));
    planContainer.replaceChildren(box);
    return attempt(box, async () => {
      const response = await send("POST", "plan-page", { name, moved: limits });
      if (response.job) return follow(response.job, box, () => show(limits));
      const report = make("div", { class: "report" });
      // Escaped by the report's own templates.
      report.innerHTML = response.html;
      report.querySelector("h1")?.remove();
      box.replaceChildren(report);
    });
  };
  /**
   * Set a limit for the next search.
   * @param {string} key
   * @param {number} value in SI
   */
  const setLimit = (key, value) => {
    movedLimits[key] = value;
    if (planContainer.childElementCount) status.textContent = "The limits have changed since this plan was calculated. Calculate the plan again.";
  };
  const sliders = plan.limits.map((limit) => {
    const id = `limit-${limit.key}`;
    // Screen readers announce the value of the slider itself.
    const formatLimit = (/** @type {number} */ value) => `${formatShort(value)} ${limit.unit}`.trimEnd();
    const output = make("output", { for: id, "aria-live": "off" }, formatLimit(limit.value / limit.factor));
    if (limit.key === "total_time") return timeField(id, limit, (seconds) => setLimit(limit.key, seconds));
    const slider = make("input", {
      id, type: "range", min: limit.low / limit.factor, max: limit.high / limit.factor, step: limit.is_integer ? 1 : "any",
      value: limit.value / limit.factor,
      "aria-valuetext": output.textContent,
      oninput: () => {
        setLimit(limit.key, Number(slider.value) * limit.factor);
        output.textContent = formatLimit(Number(slider.value));
        slider.setAttribute("aria-valuetext", output.textContent);
      },
    });
    return make("div", {}, make("label", { for: id }, limit.words), slider, output);
  });
  const folder = make("input", { required: true, autocomplete: "off", placeholder: "planned" });
  const saveContainer = make("div");
  const form = make("form", {
    class: "row",
    onsubmit: jobStarter(saveContainer, () => send("POST", "planned", { name, moved: movedLimits, folder: folder.value }),
      (job) => { location.hash = campaignAddress(job.output); }),
  }, labelled("Folder for the planned campaign", folder),
  make("button", {}, "Save limits and create campaign"));
  const search = make("form", {
    onsubmit: submitHandler(planContainer, () => {
      status.textContent = "";
      sessionStorage.setItem(limitsKey, JSON.stringify(movedLimits));
      return show({ ...movedLimits });
    }),
  }, make("div", { class: "sliders" }, ...sliders), make("button", { class: "main" }, "Calculate plan"));
  if (searchedLimits !== null) setTimeout(() => show({ ...movedLimits }));
  const editorContainer = make("div");
  const fileDetails = make("details", {
    ontoggle: () => {
      if (!fileDetails.open || editorContainer.childNodes.length) return;
      attempt(editorContainer, async () => {
        // Reload the page, because the plan has changed.
        const onSaved = () => dispatchEvent(new HashChangeEvent("hashchange"));
        editorContainer.replaceChildren(makeEditor(await get("plan-text", { name }), { saved: onSaved }).element);
      });
    },
  }, make("summary", {}, "Plan file: goal, limits and known values"), editorContainer);
  return {
    title: plan.title,
    content: [
      make("h1", {}, plan.title), make("p", { class: "quiet" }, name),
      search, status, planContainer, fileDetails,
      make("h2", {}, "Planned campaign"), form, saveContainer, commandLine(plan.command),
    ],
  };
}
