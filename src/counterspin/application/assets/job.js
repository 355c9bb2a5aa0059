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
  const words = make("p", { class: "quiet", "aria-live": "polite" });
  const stop = make("button", {
    type: "button",
    onclick: () => send("DELETE", "jobs", { number: job.number }),
  }, "Stop");
  place.replaceChildren(make("div", { class: "job" }, bar, words, stop));
  /** @param {Job} now */
  const show = (now) => {
    const [read, all] = now.progress;
    if (all && read < all) {
      bar.max = all;
      bar.value = read;
    } else {
      bar.removeAttribute("value");
    }
    const [doing, ending] = WORDS[now.kind];
    const what = now.state === "waiting" ? "Waiting for another job"
      : all && read === all ? ending : all ? `${doing}: ${read} of ${all}` : doing;
    words.textContent = `${what}, ${Math.round(now.seconds)} s`;
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
        say(`Wrote ${now.output}.`);
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
