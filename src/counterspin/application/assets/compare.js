// @ts-check
// Results beside each other, and results over the years.

import { get } from "./api.js";
import { labelled, make, stateMark } from "./dom.js";
import { fill } from "./result.js";

/** All results of the folder that can be read. */
async function allResults() {
  const folder = await get("folder");
  const all = [...folder.campaigns.flatMap(/** @param {any} c */ (c) => c.results), ...folder.results];
  return { folder, results: all.filter((result) => result.state !== "damaged") };
}

/** The page on which results are compared. */
export async function compareView() {
  const { results } = await allResults();
  const place = make("div");
  const boxes = results.map((result) => make("input", { type: "checkbox", value: result.name }));
  const reference = make("select", {});
  const show = () => {
    const chosen = boxes.filter((box) => box.checked).map((box) => box.value);
    const first = chosen.includes(reference.value) ? reference.value : chosen[0];
    reference.replaceChildren(...chosen.map((name) =>
      make("option", { value: name, selected: name === first }, name)));
    if (chosen.length >= 2) fill(place, "comparison", [first, ...chosen.filter((name) => name !== first)]);
    else place.replaceChildren(make("p", { class: "quiet" }, "Choose two results or more."));
  };
  [...boxes, reference].forEach((control) => control.addEventListener("change", show));
  show();
  return {
    title: "Compare",
    content: [
      make("h1", {}, "Compare results"),
      make("fieldset", {}, make("legend", {}, "Results"),
        ...results.map((result, i) => make("label", { class: "choice" }, boxes[i],
          `${result.name} `, stateMark(result.state, result.words),
          ` ${(result.answers ?? []).map(/** @param {any} a */ (a) => `${a.name} = ${a.text}`).join("; ")}`))),
      make("div", { class: "row" }, labelled("Each is compared with", reference)),
      place,
    ],
  };
}

/** The page of an instrument's history. */
export async function historyView() {
  const { folder, results } = await allResults();
  const place = make("div");
  const term = make("select", {}, ...folder.terms.map(/** @param {string} symbol */ (symbol) =>
    make("option", { value: symbol, selected: symbol === "K_II" }, symbol)));
  const show = () => fill(place, "history", results.map(({ name }) => name), term.value);
  term.addEventListener("change", show);
  if (results.length) show();
  else place.append(make("p", {}, "There is no result in this folder yet."));
  return {
    title: "History",
    content: [
      make("h1", {}, "History of instruments"),
      make("div", { class: "row" }, labelled("Coefficient", term)),
      place,
    ],
  };
}
