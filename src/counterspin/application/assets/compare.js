// @ts-check
// Results beside each other, and results over the years.

import { descriptionAddress } from "./addresses.js";
import { get } from "./api.js";
import { labelled, make, stateMark, symbols } from "./dom.js";
import { named } from "./improving.js";
import { fill } from "./result.js";

/** All results of the folder that can be read. */
async function allResults() {
  const folder = await get("folder");
  const all = [...folder.campaigns.flatMap((c) => c.results), ...folder.results];
  return { folder, results: all.filter((result) => result.state !== "damaged") };
}

/** The page on which results are compared. */
export async function compareView() {
  const { results } = await allResults();
  const place = make("div");
  const boxes = results.map((result) => make("input", { type: "checkbox", value: result.name }));
  const reference = make("select", {});
  const against = make("div", { class: "row" }, labelled("Reference result", reference));
  const show = () => {
    const chosen = boxes.filter((box) => box.checked).map((box) => box.value);
    against.hidden = chosen.length < 2;
    const first = chosen.includes(reference.value) ? reference.value : chosen[0];
    reference.replaceChildren(...chosen.map((name) =>
      make("option", { value: name, selected: name === first }, name)));
    if (chosen.length >= 2) fill(place, "comparison", [first, ...chosen.filter((name) => name !== first)]);
    else place.replaceChildren(make("p", { class: "quiet" }, "Choose two or more results."));
  };
  [...boxes, reference].forEach((control) => control.addEventListener("change", show));
  show();
  return {
    title: "Compare",
    content: [
      make("h1", {}, "Compare results"),
      make("fieldset", { class: "choices" }, make("legend", {}, "Results"),
        ...results.map((result, i) => make("label", { class: "choice" }, make("span", {}, boxes[i], result.name),
          make("span", {}, ...symbols((result.answers ?? []).map((a) => `${a.name} = ${a.text}`).join("; "))),
          stateMark(result.state, result.words)))),
      against,
      place,
    ],
  };
}

/** The page of an instrument's history. */
export async function historyView() {
  const { folder, results } = await allResults();
  const place = make("div");
  const term = make("select", {}, ...folder.terms.map((/** @type {{name: string, words: string}} */ one) =>
    make("option", { value: one.name, selected: one.name === "K_II" }, named(one))));
  const show = async () => {
    const told = await fill(place, "history", results.map(({ name }) => name), term.value);
    if (!told?.empty) return;
    const links = folder.campaigns.filter(({ results: own }) => own.length).map(({ name, title }) =>
      make("li", {}, make("a", { href: descriptionAddress(name, "s-accelerometers") }, title || name)));
    place.append(make("p", {}, "Add a serial number and a date to a campaign description, then calibrate the campaign again:"),
      make("ul", {}, ...links));
  };
  term.addEventListener("change", show);
  if (results.length) show();
  else place.append(make("p", {}, "This folder contains no results yet."));
  return {
    title: "History",
    content: [
      make("h1", {}, "Instrument history"),
      make("p", { class: "quiet" }, "The history lists all results with the same serial number by date. ",
        "Enter the serial number under Accelerometers and the date under Campaign in the campaign description."),
      make("div", { class: "row" }, labelled("Coefficient", term)),
      place,
    ],
  };
}
