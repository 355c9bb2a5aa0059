// @ts-check
// Background jobs: progress and results.

import { get, send } from "./api.js";
import { attempt, make, say, submitHandler, warning, working } from "./dom.js";

/** @typedef {import("./answers.js").JobEntry} Job */

/** Type of job -> labels of its work and of its last stage. */
const STAGE_LABELS = /** @type {Record<string, [string, string]>} */ ({
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
const POLL_INTERVAL = 250;

/** Number of requests for a job before its page is shown. */
const MAX_EARLY_REQUESTS = 240;

/** @param {Job} job */
export const isActive = ({ state }) => state === "waiting" || state === "running";

/**
 * Follow the active job of a type, if there is one.
 * @param {Job[]} jobs
 * @param {string} kind
 * @param {HTMLElement} container
 * @param {(job: Job) => void} onDone
 */
export function followRunning(jobs, kind, container, onDone) {
  const activeJob = jobs.find((job) => job.kind === kind && isActive(job));
  if (activeJob) follow(activeJob, container, () => onDone(activeJob));
}

/**
 * A handler that starts a job and follows it to its end; errors are shown in the container.
 * @param {HTMLElement} container
 * @param {() => Promise<Job>} startJob
 * @param {(job: Job) => void} onDone
 * @returns {(event?: Event) => Promise<void>} for a form that is sent, or a button
 */
export const jobStarter = (container, startJob, onDone) => submitHandler(container, async () => {
  container.replaceChildren(working("Starting"));
  const job = await startJob();
  follow(job, container, () => onDone(job));
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
 * The remaining time as text, extrapolated from the elapsed time; empty at the beginning.
 * @param {number} completed
 * @param {number} total
 * @param {number} seconds
 */
export const remainingTime = (completed, total, seconds) =>
  !completed || seconds < 2 ? "" : `, about ${duration(seconds * (total - completed) / completed)} left`;

/** Container -> the job that is followed in it. */
const followedJobs = /** @type {WeakMap<HTMLElement, Job>} */ (new WeakMap());

/**
 * Follow a job to its end.
 * @param {Job} job
 * @param {HTMLElement} container
 * @param {() => void} onDone
 */
export function follow(job, container, onDone) {
  const bar = make("progress", { "aria-label": `Progress of the ${job.kind}` });
  // Screen readers announce the stage, but not the numbers, which change all the time.
  const stageText = make("span", { "aria-live": "polite" });
  const progressText = make("span");
  const stop = make("button", {
    type: "button",
    onclick: () => send("DELETE", "jobs", { number: job.number }),
  }, "Stop");
  container.replaceChildren(make("div", { class: "job" }, bar,
    make("p", { class: "quiet" }, stageText, progressText), stop));
  /** @param {Job} current */
  const show = (current) => {
    const [completed, total] = current.progress;
    if (total && completed < total) {
      bar.max = total;
      bar.value = completed;
    } else {
      bar.removeAttribute("value");
    }
    const [workLabel, endLabel] = STAGE_LABELS[current.kind];
    const isWaiting = current.state === "waiting";
    const stage = isWaiting ? "Waiting for another job" : total && completed === total ? endLabel : workLabel;
    if (stageText.textContent !== stage) stageText.textContent = stage;
    const hasCount = !isWaiting && total && completed < total;
    progressText.textContent = `${hasCount ? `: ${completed} of ${total}` : ""}, ${Math.round(current.seconds)} s${hasCount ? remainingTime(completed, total, current.seconds) : ""}`;
  };
  const poll = () => attempt(container, async () => {
    // Stop if another job is followed in this container, or if the page was left or never shown.
    if (followedJobs.get(container) !== job) return;
    if (!container.isConnected && (wasShown || requestCount++ > MAX_EARLY_REQUESTS)) return;
    wasShown ||= container.isConnected;
    const jobs = await get("jobs");
    if (followedJobs.get(container) !== job) return;
    const current = jobs.find(({ number }) => number === job.number);
    if (!container.isConnected || current && isActive(current)) {
      if (current && isActive(current)) show(current);
      setTimeout(poll, POLL_INTERVAL);
    } else if (current?.state === "done") {
      if (current.output) say(`Wrote ${current.output}.`);
      onDone();
    } else {
      container.replaceChildren(warning(current?.error || `The ${job.kind} was stopped.`));
    }
  });
  let requestCount = 0;
  let wasShown = false;
  followedJobs.set(container, job);
  show(job);
  setTimeout(poll, POLL_INTERVAL);
}
