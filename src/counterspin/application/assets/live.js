// @ts-check
// A campaign while its records grow.

import { get, Refused } from "./api.js";
import { commandLine, labelled, make, warning } from "./dom.js";
import { campaignTabs } from "./tabs.js";

const PAUSE = 1000;

/**
 * The live view of a campaign.
 * @param {string} name
 */
export async function liveView(name) {
  const campaign = await get("campaign", { name });
  const goal = make("input", { placeholder: "K_II 1e-8 g/g^2", autocomplete: "off", "aria-describedby": "goal-mistake" });
  const place = make("div", {}, make("p", { class: "quiet" }, "Looking at the records."));
  const events = make("ul", { class: "quiet", "aria-live": "polite" });
  const command = make("div");
  const wrong = make("div", { id: "goal-mistake" });
  let shown = "";
  let wanted = "";
  let looking = false;
  const look = async () => {
    looking = place.isConnected;
    if (!looking) return;
    const asked = wanted;
    try {
      const told = await get("watch", { name, goal: asked });
      if (told.error) {
        looking = false;
        place.replaceChildren(warning(told.error));
        return;
      }
      if (told.html && told.html !== shown) {
        shown = told.html;
        // Escaped by the report's own templates.
        place.innerHTML = told.html;
        place.querySelector("h1")?.remove();
        command.replaceChildren(commandLine(told.command));
        globalThis.counterspin.draw(place);
        told.events.forEach(/** @param {string} one */ (one) => events.prepend(make("li", {}, one)));
      }
      if (told.complete) {
        events.prepend(make("li", {}, "Every run is as long as the campaign states."));
        looking = false;
        return;
      }
    } catch (error) {
      const words = warning(/** @type {Error} */ (error).message);
      if (!asked || !(error instanceof Refused) || error.status !== 422) {
        looking = false;
        place.replaceChildren(words);
        return;
      }
      // The goal is wrong, and the records are followed without it.
      wrong.replaceChildren(words);
      goal.setAttribute("aria-invalid", "true");
      if (wanted === asked) wanted = "";
    }
    setTimeout(look, PAUSE);
  };
  goal.addEventListener("change", () => {
    wanted = goal.value.trim();
    shown = "";
    wrong.replaceChildren();
    goal.removeAttribute("aria-invalid");
    // What is complete, or could not be followed, is looked at again for another goal.
    if (!looking) look();
  });
  setTimeout(look);
  return {
    title: `${campaign.title}, live`,
    content: [
      make("h1", {}, campaign.title), campaignTabs(name, "live"),
      make("div", { class: "row" }, labelled("Goal", goal)), wrong, place, events, command,
    ],
  };
}
