// @ts-check
// Comparisons and histories of results.

import { descriptionAddress } from "./addresses.js";
import { get } from "./api.js";
import { labelled, make, stateMark, setSymbols } from "./dom.js";
import { termLabel } from "./improving.js";
import { fillContainer } from "./result.js";

/** All results of the folder that can be read. */
async function readableResults() {
  const folder = await get("folder");
  const allResults = [...folder.campaigns.flatMap((campaign) => campaign.results), ...folder.results];
  return { folder, results: allResults.filter((result) => result.state !== "damaged") };
}

/** The page on which results are compared. */
export async function compareView() {
  const { results } = await readableResults();
  const container = make("div");
  const boxes = results.map((result) => make("input", { type: "checkbox", value: result.name }));
  const reference = make("select", {});
  const referenceRow = make("div", { class: "row" }, labelled("Reference result", reference));
  const show = () => {
    const chosenNames = boxes.filter((box) => box.checked).map((box) => box.value);
    referenceRow.hidden = chosenNames.length < 2;
    const referenceName = chosenNames.includes(reference.value) ? reference.value : chosenNames[0];
    reference.replaceChildren(...chosenNames.map((name) =>
      make("option", { value: name, selected: name === referenceName }, name)));
    if (chosenNames.length >= 2) fillContainer(container, "comparison", [referenceName, ...chosenNames.filter((name) => name !== referenceName)]);
    else container.replaceChildren(make("p", { class: "quiet" }, "Choose two or more results."));
  };
  [...boxes, reference].forEach((control) => control.addEventListener("change", show));
  show();
  return {
    title: "Compare",
    content: [
      make("h1", {}, "Compare results"),
      make("fieldset", { class: "choices" }, make("legend", {}, "Results"),
        ...results.map((result, index) => make("label", { class: "choice" }, make("span", {}, boxes[index], result.name),
          make("span", {}, ...setSymbols((result.answers ?? []).map((answer) => `${answer.name} = ${answer.text}`).join("; "))),
          stateMark(result.state, result.words)))),
      referenceRow,
      container,
    ],
  };
}

/** The page of an instrument's history. */
export async function historyView() {
  const { folder, results } = await readableResults();
  const container = make("div");
  const term = make("select", {}, ...folder.terms.map((/** @type {{name: string, words: string}} */ termEntry) =>
    make("option", { value: termEntry.name, selected: termEntry.name === "K_II" }, termLabel(termEntry))));
  const show = async () => {
    const response = await fillContainer(container, "history", results.map(({ name }) => name), term.value);
    if (!response?.empty) return;
    const links = folder.campaigns.filter(({ results: campaignResults }) => campaignResults.length).map(({ name, title }) =>
      make("li", {}, make("a", { href: descriptionAddress(name, "s-accelerometers") }, title || name)));
    container.append(make("p", {}, "Add a serial number and a date to a campaign description, then calibrate the campaign again:"),
      make("ul", {}, ...links));
  };
  term.addEventListener("change", show);
  if (results.length) show();
  else container.append(make("p", {}, "This folder contains no results yet."));
  return {
    title: "History",
    content: [
      make("h1", {}, "Instrument history"),
      make("p", { class: "quiet" }, "The history lists all results with the same serial number by date. ",
        "Enter the serial number under Accelerometers and the date under Campaign in the campaign description."),
      make("div", { class: "row" }, labelled("Coefficient", term)),
      container,
    ],
  };
}
