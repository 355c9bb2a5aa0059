// @ts-check
// Jobs that go on while the page is used: progress, and what came of them.

import { get, send } from "./api.js";
import { make, say, warning } from "./dom.js";

/** @typedef {{number: number, campaign: string, output: string, command: string, kind: string,
 *   state: string, progress: [number, number], error: string, seconds: number}} Job */

/** Kind of job -> what it does, and when all of that is done. */
const WORDS = /** @type {Record<string, [string, string]>} */ ({
  calibration: ["Reading runs", "Estimating"],
  study: ["Trials", "Writing the result"],
  simulation: ["Simulating", "Simulating"],
  forecast: ["Forecasting", "Forecasting"],
  plan: ["Planning", "Planning"],
  fit: ["Fitting", "Fitting"],
});

const PAUSE = 250;

/**
 * Follow a job to its end.
 * @param {Job} job
 * @param {HTMLElement} place
 * @param {() => void} done
 */
export function follow(job, place, done) {
  const bar = make("progress", { "aria-label": `Progress of the ${job.kind}` });
  // What goes on is spoken when it changes; numbers, which change all the time, are only seen.
  const doing = make("span", { "aria-live": "polite" });
  const numbers = make("span");
  const stop = make("button", {
    type: "button",
    onclick: () => send("DELETE", "jobs", { number: job.number }),
  }, "Stop");
  place.replaceChildren(make("div", { class: "job" }, bar,
    make("p", { class: "quiet" }, doing, numbers), stop));
  /** @param {Job} now */
  const show = (now) => {
    const [read, all] = now.progress;
    if (all && read < all) {
      bar.max = all;
      bar.value = read;
    } else {
      bar.removeAttribute("value");
    }
    const [working, ending] = WORDS[now.kind];
    const waits = now.state === "waiting";
    const what = waits ? "Waiting for another job" : all && read === all ? ending : working;
    if (doing.textContent !== what) doing.textContent = what;
    numbers.textContent = `${!waits && all && read < all ? `: ${read} of ${all}` : ""}, ${Math.round(now.seconds)} s`;
  };
  const ask = async () => {
    if (!place.isConnected && asked++ > 4) return;
    try {
      /** @type {Job[]} */
      const jobs = await get("jobs");
      const now = jobs.find(({ number }) => number === job.number);
      if (now && (now.state === "waiting" || now.state === "running")) {
        show(now);
        setTimeout(ask, PAUSE);
      } else if (now?.state === "done") {
        if (now.output) say(`Wrote ${now.output}.`);
        done();
      } else {
        place.replaceChildren(warning(now?.error || `The ${job.kind} was stopped.`));
      }
    } catch (error) {
      place.replaceChildren(warning(/** @type {Error} */ (error).message));
    }
  };
  let asked = 0;
  show(job);
  setTimeout(ask, PAUSE);
}
