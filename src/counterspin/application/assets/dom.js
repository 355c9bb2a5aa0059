// @ts-check
// Elements, made in one way; text never becomes markup here.

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
 * @param {string} words
 * @param {HTMLElement} control
 * @returns {HTMLLabelElement}
 */
export const labelled = (words, control) => make("label", {}, words, control);

/**
 * A text whose coefficients, such as K_II, have their index below the line.
 * @param {string} text
 * @returns {(Node|string)[]}
 */
export const symbols = (text) =>
  text.split(/\b((?:[KE]_(?:[A-Z]{1,3}|\d)(?:_asym)?|delta_[OP])(?![\w.]))/).map((piece, place) => {
    const [letter, ...index] = piece.split("_");
    return place % 2 ? make("span", {}, letter === "delta" ? "δ" : letter, make("sub", {}, index.join(","))) : piece;
  });

/**
 * A command, of which no option is parted at the end of a line.
 * @param {string} text
 * @returns {HTMLElement}
 */
export const command = (text) =>
  make("pre", { class: "command" }, make("code", {}, ...text.split(/( --\S+)/).map((part) =>
    part.startsWith(" --") ? make("span", {}, " ", make("span", { class: "whole" }, part.slice(1))) : part)));

/**
 * What a click does, as a command.
 * @param {string} text
 * @returns {HTMLElement}
 */
export const commandLine = (text) =>
  make("details", { class: "aside" }, make("summary", {}, "Equivalent command"), command(text));

/**
 * A warning that says what is wrong.
 * @param {string} text
 * @returns {HTMLElement}
 */
export const warning = (text) => make("p", { class: "warning", role: "alert" }, text);

/**
 * A line that says at once what the page works at, with the seconds that it has taken.
 * @param {string} text such as "Reading the files"
 * @returns {HTMLElement}
 */
export function working(text) {
  // Seconds are seen; a screen reader says only the text.
  const seconds = make("span", { "aria-hidden": "true" });
  const element = make("p", { class: "quiet working", role: "status" }, text, seconds);
  const begun = Date.now();
  const timer = setInterval(() => {
    const passed = Math.round((Date.now() - begun) / 1000);
    if (passed > 1 && !element.isConnected) clearInterval(timer);
    else seconds.textContent = passed ? `, ${passed} s` : "";
  }, 1000);
  return element;
}

/**
 * Do something; what goes wrong is said in a place.
 * @template T
 * @param {HTMLElement} place
 * @param {() => Promise<T>} work
 * @returns {Promise<T|undefined>} what the work returns; nothing where it went wrong
 */
export async function attempt(place, work) {
  try {
    return await work();
  } catch (error) {
    place.replaceChildren(warning(/** @type {Error} */ (error).message));
  }
}

/**
 * What a form does when it is sent, in place of the browser's own.
 * @param {HTMLElement} place where it is said that it failed
 * @param {() => Promise<any>} work
 * @returns {(event?: Event) => Promise<void>}
 */
export const submitting = (place, work) => async (event) => {
  event?.preventDefault();
  await attempt(place, work);
};

/**
 * What asks one question at a time: of those that come meanwhile the last is asked once more, so that
 * the last place of a slider is always asked.
 * @param {() => Promise<void>} question
 * @param {HTMLElement} wrong where it is said that it failed
 * @returns {() => Promise<void>}
 */
export function oneAtATime(question, wrong) {
  let busy = false;
  let again = false;
  const ask = async () => {
    if (busy) {
      again = true;
      return;
    }
    busy = true;
    await attempt(wrong, async () => {
      await question();
      wrong.replaceChildren();
    });
    busy = false;
    if (again) {
      again = false;
      ask();
    }
  };
  return ask;
}

let messages = 0;

/**
 * Say something for a moment, aloud too, with a button that takes it back.
 * @param {string} text
 * @param {() => Promise<void>} [undo]
 */
export function say(text, undo) {
  const place = /** @type {HTMLElement} */ (document.getElementById("said"));
  const mine = ++messages;
  place.replaceChildren(make("span", {}, text));
  if (undo) {
    place.append(" ", make("button", {
      type: "button",
      onclick: () => undo().then(() => say("Undone."), (error) => say(error.message)),
    }, "Undo"));
  }
  setTimeout(() => {
    if (mine === messages) place.replaceChildren();
  }, undo ? 10000 : 6000);
}

/**
 * A state in a word, with its colour.
 * @param {string} state
 * @param {string} words
 */
export const stateMark = (state, words) =>
  make("span", { class: `state ${state.replaceAll(" ", "-")}` }, words);
