import assert from "node:assert/strict";
import { beforeEach, mock, test } from "node:test";
import { clicked, Element, json, others, said, server } from "./browser.js";
import { campaignAddress, resultAddress } from "./addresses.js";
import { uploadFile, obtainKey, get, getTextSync, RequestError, saveFile, send } from "./api.js";
import {
  attempt, commandLine, make, oneAtATime, say, stateMark, submitHandler, setSymbols, warning,
} from "./dom.js";
import { relevantAnswers, checkUntilSettled } from "./confirm.js";
import { curvePath, arrowTip } from "./curves.js";
import { filesByName, folderName, normalizeTable } from "./import.js";
import { scaledUncertainty, termLabel, uncertaintyText } from "./improving.js";
import { jobStarter, follow, followRunning, remainingTime } from "./job.js";
import { chartColumns, stepsCovering, addPoint } from "./live.js";
import { splitTime } from "./plan.js";
import { joinQuantity, quantityField, splitQuantity } from "./quantity.js";
import { discardImport, keepImport, unfinishedImport } from "./unfinished.js";

const KEY = "counterspin-key";

beforeEach(() => {
  sessionStorage.removeItem(KEY);
  location.hash = "";
  server.requests.length = others.told.length = clicked.length = 0;
  server.answer = () => json({});
});

// A recorder's files

/**
 * Look at files where each answer leads to the next question, and all are answered already.
 * @param {number} questions
 * @param {(look: number) => boolean} overtaken whether somebody else asks during a look
 */
async function looksAt(questions, overtaken = () => false) {
  let known = 0;
  /** @type {number[]} how many answers each look sent */
  const sent = [];
  const answered = () => Array.from({ length: known }, (_, place) => `question ${place}`);
  const told = await checkUntilSettled(async () => {
    sent.push(known);
    if (overtaken(sent.length)) return null;
    known = Math.min(known + 1, questions);
    return sent.length;
  }, answered);
  return { sent, told };
}

test("files are looked at until what was answered before is sent, and no more than four times", async () => {
  assert.deepEqual(await looksAt(0), { sent: [0], told: 1 });
  assert.deepEqual(await looksAt(1), { sent: [0, 1], told: 2 });
  assert.deepEqual(await looksAt(3), { sent: [0, 1, 2, 3], told: 4 });
  assert.deepEqual(await looksAt(9), { sent: [0, 1, 2, 3], told: 4 });
  assert.deepEqual(await looksAt(9, (look) => look === 2), { sent: [0, 1], told: null });
});

test("an unfinished import is kept for the window, and its discarded files can be restored", async () => {
  const state = { folder: "new", names: ["new/b.csv"], uploaded: ["new/a.csv", "new/b.csv"], test: "", answers: { radius: "2 m" } };
  keepImport(state);
  assert.deepEqual(unfinishedImport(), state);
  server.answer = (path) => json(path === "/api/discard" ? { place: "trashed" } : { name: "new-2", files: [] });
  await discardImport();
  assert.equal(unfinishedImport(), null);
  assert.deepEqual(JSON.parse(server.requests[0].body), { folder: "new", names: state.uploaded });
  said.children.at(-1).click();
  await new Promise((done) => { setTimeout(done); });
  assert.deepEqual(JSON.parse(server.requests[1].body), { place: "trashed" });
  assert.deepEqual(unfinishedImport(), {
    folder: "new-2", names: ["new-2/b.csv"], uploaded: ["new-2/a.csv", "new-2/b.csv"], test: "", answers: { radius: "2 m" },
  });
  assert.equal(location.hash, "#/import");
});

// Addresses

test("a name is in an address as it is, whatever stands in it", () => {
  for (const name of ["2026/slow runs", "a#b?c%20d", "Prüfling 7", ""]) {
    for (const address of [campaignAddress(name), resultAddress(name)]) {
      const parts = address.split("/");
      assert.equal(parts.length, 3);
      assert.equal(decodeURIComponent(parts[2]), name);
    }
  }
});

// Elements

test("of questions that come while one is asked the last alone is asked, and its failure said", async () => {
  const asked = [];
  const wrong = make("div");
  const waiting = [];
  let place = 0;
  const ask = oneAtATime(() => {
    asked.push(place);
    return new Promise((done, failed) => waiting.push({ done, failed }));
  }, wrong);
  const turn = () => new Promise((done) => { setTimeout(done); });
  for (place of [1, 2, 3]) ask();
  assert.deepEqual(asked, [1]);
  waiting[0].done();
  await turn();
  assert.deepEqual(asked, [1, 3]);
  waiting[1].failed(new Error("No room"));
  await turn();
  assert.equal(wrong.textContent, "No room");
  place = 4;
  ask();
  waiting[2].done();
  await turn();
  assert.deepEqual([asked, wrong.textContent], [[1, 3, 4], ""]);
});

test("a form that is sent does its work here, and says where it failed", async () => {
  const place = make("div");
  let prevented = 0;
  const event = { preventDefault: () => (prevented += 1) };
  await submitHandler(place, async () => { throw new Error("No such file"); })(event);
  assert.deepEqual([prevented, place.textContent], [1, "No such file"]);
  assert.equal(await attempt(place, async () => 7), 7);
  assert.equal(place.textContent, "No such file");
});

test("attributes that are false, null or undefined are left out", () => {
  const given = { title: "a", hidden: false, id: null, lang: undefined, disabled: true, max: 0 };
  assert.deepEqual(make("p", given).attributes, { title: "a", disabled: "", max: "0" });
});

test("coefficients have their index below the line, and other names stay", () => {
  const written = (/** @type {string} */ text) =>
    setSymbols(text).map((piece) => (typeof piece === "string" ? piece : `<${piece.textContent}>`)).join("");
  assert.equal(written("u of K_II and K_4, not K_F.heating"), "u of <KII> and <K4>, not K_F.heating");
  assert.equal(written("platform.tilt.north"), "platform.tilt.north");
});

// What if something were known better

test("a source is named in words with its symbol, and its size is in its own unit", () => {
  const source = { name: "K_OO", words: "second-order output-axis coefficient", u: 2e-6, factor: 1e6, unit: "µg/g²", share: 0.9 };
  assert.equal(termLabel(source), "second-order output-axis coefficient, K_OO");
  assert.equal(termLabel({ name: "noise of Qx", words: "" }), "noise of Qx");
  assert.equal(uncertaintyText(source, scaledUncertainty(source, 0)), "2 µg/g²");
  assert.equal(uncertaintyText(source, scaledUncertainty(source, -2)), "0.02 µg/g²");
  assert.equal(uncertaintyText(source, scaledUncertainty(source, 1)), "20 µg/g²");
});

test("a pasted table is lines without empty ones, its tabs and commas as they are", () => {
  assert.equal(normalizeTable("pos\treading\r\n0\t1,25\r\n\r\n30\t1,08\t\n"), "pos\treading\n0\t1,25\n30\t1,08\n");
});

test("answers are sent to the questions that ask for them, and none is dropped", () => {
  const question = (/** @type {string} */ key, /** @type {string[]} */ choices = []) => ({ key, text: "", example: "", choices, guess: null });
  const answers = { gravity: "9.81 m/s^2", radius: "2.5 m", sense: "ccw", time: "t" };
  assert.deepEqual(relevantAnswers([question("gravity"), question("time", ["s", "none"])], answers), { gravity: "9.81 m/s^2" });
  assert.deepEqual(relevantAnswers([question("sense", ["ccw", "cw"]), question("radius")], answers), { sense: "ccw", radius: "2.5 m" });
  assert.equal(Object.keys(answers).length, 4);
});

test("a folder is named by the files' common beginning, and not as another campaign", () => {
  const named = (/** @type {string[]} */ names, /** @type {string[]} */ taken = []) => folderName(names, "2026-03-01", new Set(taken));
  assert.equal(named(["lot 7 run1.csv", "lot 7 run2.csv"]), "lot-7-run");
  assert.equal(named(["book.xlsx"]), "book");
  assert.equal(named(["slow.csv", "fast.csv"]), "campaign-2026-03-01");
  assert.equal(named(["book.xlsx"], ["book", "book-2"]), "book-3");
});

test("files of one name get numbers, and a file that was chosen twice is uploaded once", () => {
  const file = (/** @type {string} */ name, size = 1, lastModified = 0) => /** @type {any} */ ({ name, size, lastModified });
  const named = (/** @type {any[]} */ ...files) => [...filesByName(files).keys()];
  assert.deepEqual(named(file("a.csv"), file("a.csv"), file("b.csv")), ["a.csv", "b.csv"]);
  assert.deepEqual(named(file("a.1.csv"), file("a.1.csv", 2), file("a.1.csv", 1, 9)), ["a.1.csv", "a.1-2.csv", "a.1-3.csv"]);
  assert.deepEqual(named(file("log", 1), file("log", 2)), ["log", "log-2"]);
});

test("a menu offers a detected value that is not among the usual choices", () => {
  const options = (/** @type {string|null} */ guess) => {
    const question = { key: "time unit", text: "", example: "s", choices: ["s", "ms"], guess, units: [] };
    return /** @type {any} */ (quantityField(question, "", "", true, () => {}).control).children.map((/** @type {any} */ option) => option.value);
  };
  assert.deepEqual(options("ns"), ["ns", "s", "ms"]);
  assert.deepEqual(options("ms"), ["s", "ms"]);
  assert.deepEqual(options(null), ["", "s", "ms"]);
});

test("a quantity is parted into value, uncertainty and unit, and put together again", () => {
  const units = ["m", "mm"];
  assert.deepEqual(splitQuantity("2.5 ± 1e-5 m", units), { value: "2.5", u: "1e-5", unit: "m" });
  assert.deepEqual(splitQuantity("2500+/-0,01 mm", units), { value: "2500", u: "0,01", unit: "mm" });
  assert.deepEqual(splitQuantity("9.81", units), { value: "9.81", u: "", unit: "" });
  // The server judges everything else as it is typed.
  assert.equal(splitQuantity("98.4 furlong", units), null);
  assert.equal(splitQuantity("about 2", units), null);
  assert.equal(joinQuantity("2.5", "1e-5", "m"), "2.5 ± 1e-5 m");
  assert.equal(joinQuantity("2.5", "", "m"), "2.5 m");
  assert.equal(joinQuantity("45.75N", "", "deg"), "45.75N");
  assert.equal(joinQuantity("", "1e-5", "m"), "");
});

test("the remaining time follows from the time for what is done", () => {
  assert.equal(remainingTime(0, 10, 30), "");
  assert.equal(remainingTime(5, 10, 1), "");
  assert.equal(remainingTime(5, 10, 20), ", about 20 s left");
  assert.equal(remainingTime(100, 300, 196), ", about 7 min left");
  assert.equal(remainingTime(1, 1001, 36), ", about 10.0 h left");
});

test("a curve is one line, which begins again after a gap", () => {
  assert.equal(curvePath([[0, 1], [0, 1], null, [1, 1]]), "M0 45L0.5 3L1 3L1.5 45M3 3L3.5 3");
  assert.equal(curvePath([[2, 2]]), "M0 24L0.5 24");
});

test("arrows on the circle begin at up and turn clockwise", () => {
  assert.deepEqual([0, 90, 180, 270].map((angle) => arrowTip(angle, 10).map((one) => one + 0)), [[0, -10], [10, 0], [0, 10], [-10, 0]]);
});

test("a time is in the largest unit of which there is one", () => {
  assert.deepEqual([700, 3600, 5400, 172800].map(splitTime), [[11.67, "min"], [1, "h"], [1.5, "h"], [2, "days"]]);
});

test("what was reached is one point for each amount of records, the newest last", () => {
  const at = (/** @type {number} */ minutes, /** @type {number|null} */ u) => ({ minutes, u: [{ name: "K_II", u }] });
  let seen = [at(1, null), at(2, 3)].reduce(addPoint, []);
  seen = addPoint(seen, at(2, 2));
  assert.deepEqual(chartColumns(seen), [[1, 2], [null, 2]]);
  // Records that are made anew begin again.
  assert.deepEqual(chartColumns(addPoint(seen, at(0.5, 9))), [[0.5], [9]]);
});

test("an axis of uncertainties has steps of 1, 2 and 5 about its range", () => {
  assert.deepEqual(stepsCovering(2.426, 3.2), [2, 5]);
  assert.deepEqual(stepsCovering(0.03, 1.5), [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2]);
  assert.deepEqual(stepsCovering(2, 5), [2, 5]);
  assert.deepEqual(stepsCovering(2, 2), [2, 5]);
  assert.deepEqual(stepsCovering(7, 8), [5, 10]);
});

test("a listener listens, and a value is a property", () => {
  let calls = 0;
  const button = make("button", { onclick: () => (calls += 1), value: "x" });
  button.click();
  assert.equal(calls, 1);
  assert.equal(button.value, "x");
  assert.deepEqual(button.attributes, {});
});

test("text stays text, and what is not there is no child", () => {
  const element = make("p", {}, "<b>", null, undefined, make("i", {}, "&amp;"), "");
  assert.equal(element.textContent, "<b>&amp;");
  assert.equal(element.children.length, 3);
  assert.equal(warning("<script>").children[0], "<script>");
  assert.equal(commandLine("rm *").textContent, "Equivalent commandrm *");
});

test("a state's words have a class of one word each", () => {
  const mark = stateMark("with reservations now", "so so");
  assert.equal(mark.attributes.class, "state with-reservations-now");
  assert.equal(mark.textContent, "so so");
});

test("what is said goes after a while, unless something else was said since", () => {
  mock.timers.enable({ apis: ["setTimeout"] });
  say("one");
  mock.timers.tick(5000);
  say("two");
  mock.timers.tick(1500);
  assert.equal(said.textContent, "two");
  mock.timers.tick(5000);
  assert.equal(said.textContent, "");
  mock.timers.reset();
});

// Requests

test("what is not said is not asked, and the rest is quoted", async () => {
  await get("result", { name: "a&b=c", term: undefined });
  await get("jobs", { kind: undefined });
  assert.deepEqual(server.requests.map(({ path }) => path), ["/api/result?name=a%26b%3Dc", "/api/jobs"]);
  assert.equal(server.requests[0].body, undefined);
});

test("a request carries the key, and a form as JSON", async () => {
  await send("POST", "calibrate", { name: "a", method: undefined });
  sessionStorage.setItem(KEY, "k1");
  await uploadFile("a b.csv", "bytes");
  const [form, file] = server.requests;
  assert.equal(form.headers.Authorization, undefined);
  assert.deepEqual(JSON.parse(form.body), { name: "a" });
  assert.equal(file.path, "/api/files?name=a+b.csv");
  assert.equal(file.headers.Authorization, "Bearer k1");
  assert.equal(file.headers["Content-Type"], "application/octet-stream");
});

test("a refusal says what the server says, or its status", async () => {
  server.answer = () => json({ error: "There is no result.", field: "name" }, 404);
  await assert.rejects(get("result"), (error) => {
    assert.ok(error instanceof RequestError);
    assert.equal(error.message, "There is no result.");
    assert.deepEqual([error.status, error.body.field], [404, "name"]);
    return true;
  });
  server.answer = () => new Response("<html>", { status: 502 });
  await assert.rejects(get("result"), { status: 502, message: "The server responded with status 502." });
  server.answer = () => {
    throw new TypeError("network");
  };
  await assert.rejects(get("result"), { status: 0, message: /is not responding/ });
});

test("a key that the server no longer knows is forgotten, but none that came since", async () => {
  server.answer = () => json({ error: "No key." }, 401);
  sessionStorage.setItem(KEY, "old");
  await assert.rejects(get("jobs"), { status: 401 });
  assert.equal(sessionStorage.getItem(KEY), null);
  sessionStorage.setItem(KEY, "old");
  server.answer = () => {
    sessionStorage.setItem(KEY, "new");
    return json({ error: "No key." }, 401);
  };
  await assert.rejects(get("jobs"), { status: 401 });
  assert.equal(sessionStorage.getItem(KEY), "new");
});

test("a text for printing is waited for, and is empty where it is refused", () => {
  sessionStorage.setItem(KEY, "k1");
  server.answer = () => ({ status: 200, responseText: "<svg>" });
  assert.equal(getTextSync("figure", { name: "a b" }), "<svg>");
  const [request] = server.requests;
  assert.deepEqual([request.path, request.later], ["/api/figure?name=a+b", false]);
  assert.equal(request.headers.Authorization, "Bearer k1");
  server.answer = () => ({ status: 404, responseText: "no" });
  assert.equal(getTextSync("figure", {}), "");
});

test("a file is saved from an address that counts once", async () => {
  server.answer = () => json({ ticket: "t7" });
  await saveFile("report", { name: "a" });
  assert.deepEqual(JSON.parse(server.requests[0].body), { name: "report", parameters: { name: "a" } });
  assert.deepEqual(clicked.map(({ href }) => href), ["/api/ticket/t7"]);
});

// The key

test("a link's token is given for the key and stays in no address", async () => {
  location.hash = "#token=abc";
  server.answer = () => json({ key: "k2" });
  await obtainKey();
  assert.equal(location.hash, "#/");
  assert.deepEqual(JSON.parse(server.requests[0].body), { token: "abc" });
  assert.equal(sessionStorage.getItem(KEY), "k2");
  assert.deepEqual(others.told, [{ key: "k2", renewed: true }]);
});

test("without a token another window tells the key, or nobody does", async () => {
  mock.timers.enable({ apis: ["setTimeout"] });
  const entered = obtainKey();
  assert.deepEqual(others.told, [{ asked: true }]);
  for (const hear of others.hear) hear({ key: "k3" });
  await entered;
  assert.equal(sessionStorage.getItem(KEY), "k3");
  sessionStorage.removeItem(KEY);
  const alone = obtainKey();
  mock.timers.tick(300);
  await alone;
  assert.equal(sessionStorage.getItem(KEY), null);
  mock.timers.reset();
});

test("a window tells its key when asked, and takes over only a renewed one", () => {
  const [hear] = others.hear;
  hear({ asked: true });
  assert.deepEqual(others.told, []);
  sessionStorage.setItem(KEY, "mine");
  hear({ asked: true });
  assert.deepEqual(others.told, [{ key: "mine" }]);
  hear({ key: "other" });
  assert.equal(sessionStorage.getItem(KEY), "mine");
  hear({ key: "new", renewed: true });
  assert.equal(sessionStorage.getItem(KEY), "new");
});

// Jobs

const job = (more) => ({
  number: 3, kind: "calibration", state: "running", progress: [0, 0], seconds: 0.4, output: "", ...more,
});

/** Follow a job that the server tells these states of, one after another. */
const followed = (...states) => followedUntil(0, ...states);

/** Follow a job on a page that is shown after some requests. */
async function followedUntil(shownAfter, ...states) {
  const place = new Element("div");
  place.isConnected = shownAfter === 0;
  const seen = [];
  let done = 0;
  mock.timers.enable({ apis: ["setTimeout"] });
  server.answer = () => json(states.shift());
  follow(job(), place, () => (done += 1));
  while (states.length) {
    mock.timers.tick(250);
    for (let turn = 0; turn < 20; turn += 1) await Promise.resolve();
    await new Promise(setImmediate);
    seen.push(place.textContent);
    place.isConnected = seen.length >= shownAfter;
  }
  mock.timers.reset();
  return { place, seen, done };
}

test("a job says what it does, how far it is, and that it is done", async () => {
  const { seen, done } = await followed(
    [job({ state: "waiting", progress: [1, 4] })],
    [job({ number: 8 }), job({ progress: [1, 4], seconds: 1.6 })],
    [job({ progress: [4, 4], seconds: 2.4 })],
    [job({ state: "done", output: "result.json" })],
  );
  assert.deepEqual(seen.slice(0, 3), [
    "Waiting for another job, 0 sStop",
    "Reading runs: 1 of 4, 2 sStop",
    "Estimating, 2 sStop",
  ]);
  assert.equal(done, 1);
  assert.equal(said.textContent, "Wrote result.json.");
});

test("a job that fails says why, and one that is gone was stopped", async () => {
  const failed = await followed([job({ state: "failed", error: "No such record." })]);
  assert.equal(failed.place.textContent, "No such record.");
  const gone = await followed([]);
  assert.equal(gone.place.textContent, "The calibration was stopped.");
  assert.equal(failed.done + gone.done, 0);
});

test("a job is followed until its page is shown, however long that takes", async () => {
  const working = [job({ progress: [1, 2] })], ended = [job({ state: "done" })];
  const early = await followedUntil(9, ...Array(8).fill(working), ended, ended);
  assert.deepEqual([early.done, early.seen.length], [1, 10]);
  assert.equal((await followedUntil(3, ended, ended, ended)).done, 0);
});

test("a job that cannot be begun says why in its place, and one that goes on is followed", async () => {
  const place = make("div");
  server.answer = () => json({ error: "give it a name" }, 422);
  await jobStarter(place, () => send("POST", "study", {}), () => assert.fail())();
  assert.equal(place.textContent, "give it a name");
  mock.timers.enable({ apis: ["setTimeout"] });
  followRunning([job({ kind: "study", state: "done" }), job({ kind: "fit" })], "study", place, () => {});
  assert.equal(place.textContent, "give it a name");
  followRunning([job({ kind: "study" })], "study", place, () => {});
  assert.equal(place.textContent, "Trials, 0 sStop");
  mock.timers.reset();
});

test("a job is stopped by its button", () => {
  mock.timers.enable({ apis: ["setTimeout"] });
  const place = new Element("div");
  follow(job(), place, () => {});
  const [box] = place.children;
  box.children.find(({ name }) => name === "button").click();
  mock.timers.reset();
  const [{ method, path, body }] = server.requests;
  assert.deepEqual([method, path, JSON.parse(body)], ["DELETE", "/api/jobs", { number: 3 }]);
});

test("of two jobs in one place the second is followed", async () => {
  const place = new Element("div");
  const done = [];
  mock.timers.enable({ apis: ["setTimeout"] });
  server.answer = () => json([job({ state: "done" }), job({ number: 4, state: "done" })]);
  follow(job(), place, () => done.push(3));
  follow(job({ number: 4 }), place, () => done.push(4));
  mock.timers.tick(250);
  for (let turn = 0; turn < 20; turn += 1) await new Promise(setImmediate);
  mock.timers.reset();
  assert.deepEqual(done, [4]);
  assert.equal(server.requests.length, 1);
});
