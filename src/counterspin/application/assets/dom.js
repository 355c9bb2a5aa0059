// @ts-check
// Creation of elements; text is never interpreted as markup.

/**
 * Make an element.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} name
 * @param {Record<string, any>} [attributes] "on..." takes a listener; false and null leave out
 * @param {...(Node|string|null|undefined)} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function make(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === false || value === null || value === undefined) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "value") /** @type {any} */ (element).value = value;
    else element.setAttribute(key, value === true ? "" : String(value));
  }
  for (const child of children) if (child !== null && child !== undefined) element.append(child);
  return element;
}

/**
 * A field with its label.
 * @param {string} label
 * @param {HTMLElement} control
 * @returns {HTMLLabelElement}
 */
export const labelled = (label, control) => make("label", {}, label, control);

/**
 * A text with the indices of coefficients, such as K_II, as subscripts.
 * @param {string} text
 * @returns {(Node|string)[]}
 */
export const setSymbols = (text) =>
  text.split(/\b((?:[KE]_(?:[A-Z]{1,3}|\d)(?:_asym)?|delta_[OP])(?![\w.]))/).map((part, partIndex) => {
    const [letter, ...index] = part.split("_");
    return partIndex % 2 ? make("span", {}, letter === "delta" ? "δ" : letter, make("sub", {}, index.join(","))) : part;
  });

/**
 * A command whose options are not broken at the end of a line.
 * @param {string} text
 * @returns {HTMLElement}
 */
export const commandBlock = (text) =>
  make("pre", { class: "command" }, make("code", {}, ...text.split(/( --\S+)/).map((part) =>
    part.startsWith(" --") ? make("span", {}, " ", make("span", { class: "whole" }, part.slice(1))) : part)));

/**
 * The command that is equivalent to an action.
 * @param {string} text
 * @returns {HTMLElement}
 */
export const commandLine = (text) =>
  make("details", { class: "aside" }, make("summary", {}, "Equivalent command"), commandBlock(text));

/**
 * A warning.
 * @param {string} text
 * @returns {HTMLElement}
 */
export const warning = (text) => make("p", { class: "warning", role: "alert" }, text);

/**
 * A progress message with the elapsed seconds.
 * @param {string} text such as "Reading the files"
 * @returns {HTMLElement}
 */
export function working(text) {
  // Screen readers announce only the text.
  const seconds = make("span", { "aria-hidden": "true" });
  const element = make("p", { class: "quiet working", role: "status" }, text, seconds);
  const startTime = Date.now();
  const timer = setInterval(() => {
    const elapsed = Math.round((Date.now() - startTime) / 1000);
    if (elapsed > 1 && !element.isConnected) clearInterval(timer);
    else seconds.textContent = elapsed ? `, ${elapsed} s` : "";
  }, 1000);
  return element;
}

/**
 * Run a task; show its error in a container.
 * @template T
 * @param {HTMLElement} container
 * @param {() => Promise<T>} work
 * @returns {Promise<T|undefined>} what the work returns; nothing where it went wrong
 */
export async function attempt(container, work) {
  try {
    return await work();
  } catch (error) {
    container.replaceChildren(warning(/** @type {Error} */ (error).message));
  }
}

/**
 * A handler of a form's submit event.
 * @param {HTMLElement} container where it is said that it failed
 * @param {() => Promise<any>} work
 * @returns {(event?: Event) => Promise<void>}
 */
export const submitHandler = (container, work) => async (event) => {
  event?.preventDefault();
  await attempt(container, work);
};

/**
 * A function that runs a task one at a time. If it is called meanwhile, the task runs once more, so that
 * the final position of a slider is always used.
 * @param {() => Promise<void>} task
 * @param {HTMLElement} errorBox where it is said that it failed
 * @returns {() => Promise<void>}
 */
export function oneAtATime(task, errorBox) {
  let isRunning = false;
  let isPending = false;
  const run = async () => {
    if (isRunning) {
      isPending = true;
      return;
    }
    isRunning = true;
    await attempt(errorBox, async () => {
      await task();
      errorBox.replaceChildren();
    });
    isRunning = false;
    if (isPending) {
      isPending = false;
      run();
    }
  };
  return run;
}

let messageCount = 0;

/**
 * Show a message for a moment, also for screen readers, with an optional Undo button.
 * @param {string} text
 * @param {() => Promise<void>} [undo]
 */
export function say(text, undo) {
  const container = /** @type {HTMLElement} */ (document.getElementById("said"));
  const messageNumber = ++messageCount;
  container.replaceChildren(make("span", {}, text));
  if (undo) {
    container.append(" ", make("button", {
      type: "button",
      onclick: () => undo().then(() => say("Undone."), (error) => say(error.message)),
    }, "Undo"));
  }
  setTimeout(() => {
    if (messageNumber === messageCount) container.replaceChildren();
  }, undo ? 10000 : 6000);
}

/**
 * The label of a state, with its colour.
 * @param {string} state
 * @param {string} label
 */
export const stateMark = (state, label) =>
  make("span", { class: `state ${state.replaceAll(" ", "-")}` }, label);
