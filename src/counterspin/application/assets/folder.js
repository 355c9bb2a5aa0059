// @ts-check
// The folder: its campaigns with their state, and what to begin with.

import { campaignAddress, resultAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { importEntry } from "./import.js";
import { attempt, labelled, make, say, stateMark, submitting, symbols, working } from "./dom.js";
import { pagePart } from "./result.js";
import { keepImport } from "./unfinished.js";

/** @typedef {import("./answers.js").CampaignEntry} CampaignEntry */

/**
 * A result in a few lines.
 * @param {import("./answers.js").ResultEntry} result
 */
export const resultLines = (result) => [
  ...(result.answers ?? []).map(({ name, text }) =>
    make("p", { class: "answer-line" }, ...symbols(`${name} = ${text}`))),
  make("p", {}, stateMark(result.state, result.words), " ",
    make("a", { href: resultAddress(result.name) }, result.name)),
];

/** @param {CampaignEntry} campaign */
function campaignCard(campaign) {
  const result = campaign.results[0];
  const what = [
    campaign.instruments.join(", "),
    campaign.runs ? `${campaign.runs} run${campaign.runs === 1 ? "" : "s"}` : "",
    campaign.name,
  ].filter(Boolean).join(" · ");
  return make("li", { class: "card line" },
    make("div", {}, make("h2", {}, make("a", { href: campaignAddress(campaign.name) }, campaign.title)),
      make("p", { class: "quiet" }, what)),
    make("div", {}, ...(result?.answers ?? []).map((a) =>
      make("p", { class: "answer-line" }, ...symbols(`${a.name} = ${a.text}`))),
    make("p", {}, stateMark(campaign.state, campaign.words),
      campaign.missing.length ? ` Missing files: ${campaign.missing.length}` : "",
      campaign.mistakes.length ? ` Mistakes: ${campaign.mistakes.length}` : "")));
}

/** What campaigns are sorted by -> what a campaign has of it, the first one least. */
const ORDERS = {
  "name": (/** @type {CampaignEntry} */ one) => one.name,
  "title": (/** @type {CampaignEntry} */ one) => one.title,
  "newest result": (/** @type {CampaignEntry} */ one) => -(one.results[0]?.written ?? 0),
  "state": (/** @type {CampaignEntry} */ one) => one.words,
};

/**
 * The campaigns, of which those are shown that a search finds.
 * @param {CampaignEntry[]} campaigns
 */
function campaignList(campaigns) {
  const cards = campaigns.map((campaign) => ({ campaign, card: campaignCard(campaign) }));
  const list = make("ul", { class: "cards" }, ...cards.map(({ card }) => card));
  if (campaigns.length < 2) return [list];
  const sought = make("input", { type: "search", autocomplete: "off" });
  const order = make("select", {}, ...Object.keys(ORDERS).map((one) => make("option", {}, one)));
  const count = make("p", { class: "quiet", role: "status" });
  const arrange = () => {
    const words = sought.value.toLowerCase().split(/\s+/).filter(Boolean);
    const key = ORDERS[/** @type {keyof typeof ORDERS} */ (order.value)];
    const found = cards.filter(({ card }) =>
      words.every((word) => card.textContent?.toLowerCase().includes(word)));
    found.sort((one, other) => (key(one.campaign) < key(other.campaign) ? -1 : 1));
    list.replaceChildren(...found.map(({ card }) => card));
    count.textContent = words.length ? `${found.length} of ${cards.length}` : "";
  };
  sought.addEventListener("input", arrange);
  order.addEventListener("change", arrange);
  return [make("div", { class: "row" }, labelled("Search", sought), labelled("Sort by", order), count), list];
}

function newCampaign() {
  const name = make("input", { required: true, autocomplete: "off", placeholder: "my-campaign" });
  const test = make("select", {},
    make("option", { value: "double-turntable" }, "Double turntable"),
    make("option", { value: "tumble" }, "Tumble test"),
    make("option", { value: "arm" }, "Arm centrifuge"));
  const wrong = make("div");
  const form = make("form", {
    class: "row",
    onsubmit: submitting(wrong, async () => {
      wrong.replaceChildren(working("Writing the example"));
      const made = await send("POST", "campaign", { name: name.value, test: test.value });
      say(`Wrote ${made.name}/campaign.toml.`);
      location.hash = campaignAddress(made.name);
    }),
  }, labelled("Example folder", name), labelled("Test type", test),
  make("button", {}, "Write example"));
  return [
    make("h2", {}, "New campaign"), importEntry(),
    make("details", {}, make("summary", {}, "Start from a template"), form, wrong),
  ];
}

/**
 * The history of each instrument as a chart, once there are results to be followed.
 * @param {string[]} names of results
 */
function instruments(names) {
  const place = make("section", { class: "instruments" });
  if (names.length > 1) {
    pagePart("history", names).then(({ part }) => {
      const charts = [...part?.querySelectorAll("figure") ?? []];
      if (!charts.length) return;
      place.append(make("h2", {}, "Instruments"), make("div", { class: "charts report" }, ...charts));
      globalThis.counterspin.draw(place);
    }, () => {}); // Where the server has gone, the next click says it.
  }
  return place;
}

/**
 * The campaigns in the trash, each with a button that restores it.
 * @param {{place: string, name: string}[]} trash
 */
function trashPart(trash) {
  const wrong = make("div");
  const restore = (/** @type {string} */ place) => () => attempt(wrong, async () => {
    wrong.replaceChildren(working("Restoring"));
    const { name, files } = await send("POST", "restore", { place });
    say(`Restored ${name}.`);
    if (files.length) keepImport({ folder: name, names: files, uploaded: files, test: "", answers: {} });
    location.hash = files.length ? "#/import" : campaignAddress(name);
  });
  return make("details", { class: "keeping" }, make("summary", {}, `Trash (${trash.length})`),
    ...trash.map(({ place, name }) => make("div", { class: "row" }, make("span", {}, name),
      make("button", { type: "button", onclick: restore(place) }, `Restore ${name}`))), wrong);
}

/** Go to where a campaign begins, below those that there are. */
function begin() {
  const field = /** @type {HTMLElement} */ (document.querySelector(".drop input"));
  field.closest("section")?.scrollIntoView();
  field.focus({ preventScroll: true });
}

/** The list of campaigns. */
export async function folderView() {
  const folder = await get("folder");
  const results = folder.results.filter((r) => r.state !== "damaged");
  const content = [
    make("div", { class: "head" }, make("h1", {}, folder.folder),
      folder.campaigns.length > 2 ? make("button", { type: "button", class: "main", onclick: begin }, "New campaign") : null),
    ...folder.campaigns.length
      ? campaignList(folder.campaigns)
      : [make("p", {}, "counterspin calibrates accelerometers from records of a centrifuge or tumble test. It estimates the error " +
        "coefficients, in particular K_II, and their uncertainties. This folder contains no campaigns yet.")],
    instruments([...folder.campaigns.flatMap((c) => c.results), ...folder.results]
      .filter((r) => r.state !== "damaged").map((r) => r.name)),
    make("section", {}, ...newCampaign()),
  ];
  if (results.length) {
    content.push(make("section", {}, make("h2", {}, "Other results"),
      make("ul", { class: "cards" }, ...results.map((r) =>
        make("li", { class: "card" }, make("h3", {}, r.title || r.name), ...resultLines(r))))));
  }
  if (folder.trash.length) content.push(trashPart(folder.trash));
  return { title: folder.folder, content };
}

