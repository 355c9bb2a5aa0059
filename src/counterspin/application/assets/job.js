// @ts-check
// Jobs that go on while the page is used: progress, and what came of them.

import { get, send } from "./api.js";
import { attempt, make, say, submitting, warning, working } from "./dom.js";

/** @typedef {import("./answers.js").JobEntry} Job */

/** Kind of job -> what it does, and when all of that is done. */
const WORDS = /** @type {Record<string, [string, string]>} */ ({
  calibration: ["Reading runs", "Estimating"],
  study: ["Trials", "Writing the result"],
  estimate: ["Estimating the duration", "Estimating the duration"],
  simulation: ["Simulating", "Simulating"],
  forecast: ["Forecasting", "Forecasting"],
  plan: ["Planning", "Planning"],
  fit: ["Fitting", "Fitting"],
  sample: ["Simulating", "Estimating"],
});

/** Time between two requests for the state of a job, ms. */
const PAUSE = 250;

/** Requests before the page that follows a job is shown; a busy server takes its time. */
const MOST_EARLY_REQUESTS = 240;

/** @param {Job} job */
const goesOn = ({ state }) => state === "waiting" || state === "running";

/**
 * Follow the job of a kind that goes on already, if there is one.
 * @param {Job[]} jobs
 * @param {string} kind
 * @param {HTMLElement} place
 * @param {(job: Job) => void} done
 */
export function followRunning(jobs, kind, place, done) {
  const running = jobs.find((job) => job.kind === kind && goesOn(job));
  if (running) follow(running, place, () => done(running));
}

/**
 * What begins a job, and follows it to its end; what goes wrong is said in its place.
 * @param {HTMLElement} place
 * @param {() => Promise<Job>} begin
 * @param {(job: Job) => void} done
 * @returns {(event?: Event) => Promise<void>} for a form that is sent, or a button
 */
export const carryOut = (place, begin, done) => submitting(place, async () => {
  place.replaceChildren(working("Starting"));
  const job = await begin();
  follow(job, place, () => done(job));
});

/**
 * A duration in words.
 * @param {number} seconds
 */
export function duration(seconds) {
  if (seconds < 100) return `${Math.max(1, Math.round(seconds))} s`;
  return seconds < 6000 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

/**
 * The remaining time in words, from the time for what is done; empty at the beginning.
 * @param {number} done
 * @param {number} all
 * @param {number} seconds
 */
export const remaining = (done, all, seconds) =>
  !done || seconds < 2 ? "" : `, about ${duration(seconds * (all - done) / done)} left`;

/** Place -> the job that is followed there; an earlier one is followed no longer. */
const followed = /** @type {WeakMap<HTMLElement, Job>} */ (new WeakMap());

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
    const counted = !waits && all && read < all;
    numbers.textContent = `${counted ? `: ${read} of ${all}` : ""}, ${Math.round(now.seconds)} s${counted ? remaining(read, all, now.seconds) : ""}`;
  };
  const ask = () => attempt(place, async () => {
    // A later job is followed here, the page was left, or it was never shown.
    if (followed.get(place) !== job) return;
    if (!place.isConnected && (wasShown || asked++ > MOST_EARLY_REQUESTS)) return;
    wasShown ||= place.isConnected;
    const jobs = await get("jobs");
    if (followed.get(place) !== job) return;
    const now = jobs.find(({ number }) => number === job.number);
    if (!place.isConnected || now && goesOn(now)) {
      if (now && goesOn(now)) show(now);
      setTimeout(ask, PAUSE);
    } else if (now?.state === "done") {
      if (now.output) say(`Wrote ${now.output}.`);
      done();
    } else {
      place.replaceChildren(warning(now?.error || `The ${job.kind} was stopped.`));
    }
  });
  let asked = 0;
  let wasShown = false;
  followed.set(place, job);
  show(job);
  setTimeout(ask, PAUSE);
}
