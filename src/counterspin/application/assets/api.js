// @ts-check
// What the page asks the server; every request goes to the server that the page came from, with
// the key, which this window keeps.

/** What the key is kept and asked for by. */
const KEY = "counterspin-key";

/** How long other windows have to tell the key, ms. */
const PATIENCE = 300;

/**
 * Windows of this very server, no other is heard: one that a link of the page has opened asks for
 * the key, and all have it anew from one that came by a link of the terminal.
 */
const windows = new BroadcastChannel(KEY);
windows.addEventListener("message", ({ data }) => {
  const key = sessionStorage.getItem(KEY);
  if (data.asked && key) windows.postMessage({ key });
  if (data.key && (data.renewed || !key)) sessionStorage.setItem(KEY, data.key);
});

/** An answer that is no: its status, and what the server says. */
export class Refused extends Error {
  /**
   * @param {number} status
   * @param {{error: string, [key: string]: any}} told
   */
  constructor(status, told) {
    super(told.error);
    this.status = status;
    this.told = told;
  }
}

/**
 * Ask the server.
 * @param {string} method
 * @param {string} name
 * @param {Record<string, any>} [said] words of a query, or the form
 * @returns {Promise<Response>}
 */
async function ask(method, name, said = {}) {
  const given = Object.fromEntries(Object.entries(said).filter(([, value]) => value !== undefined));
  const reading = method === "GET";
  const query = reading && Object.keys(given).length ? `?${new URLSearchParams(given)}` : "";
  return exchange(`${name}${query}`, {
    method,
    headers: reading ? {} : { "Content-Type": "application/json" },
    body: reading ? undefined : JSON.stringify(given),
  });
}

/**
 * Add the key, where there is one.
 * @param {Record<string, string>} headers
 * @returns {Record<string, string>}
 */
function withKey(headers) {
  const key = sessionStorage.getItem(KEY);
  return key ? { ...headers, Authorization: `Bearer ${key}` } : headers;
}

/**
 * Send a request with the key.
 * @param {string} path
 * @param {{method: string, headers: Record<string, string>, body?: BodyInit}} request
 * @returns {Promise<Response>}
 */
async function exchange(path, request) {
  const key = sessionStorage.getItem(KEY);
  const headers = withKey(request.headers);
  let response;
  try {
    response = await fetch(`/api/${path}`, { ...request, headers });
  } catch {
    throw new Refused(0, { error: "The server does not respond. Check that `counterspin serve` is still running." });
  }
  if (response.ok) return response;
  // One of an earlier server is of no use, to other windows either.
  if (response.status === 401 && sessionStorage.getItem(KEY) === key) sessionStorage.removeItem(KEY);
  const told = await response.json().catch(() => ({ error: `The server responded with status ${response.status}.` }));
  throw new Refused(response.status, told);
}

/** @typedef {import("./answers.js").Answers} Answers */

/** @type {<N extends keyof Answers["GET"]>(name: N, said?: Record<string, any>) => Promise<Answers["GET"][N]>} */
export const get = async (name, said) => (await ask("GET", name, said)).json();

/** @type {(name: string, said?: Record<string, any>) => Promise<string>} */
export const getText = async (name, said) => (await ask("GET", name, said)).text();

/**
 * Ask for a text and wait for it, where nothing may go on before: printing waits for no promise.
 * @param {string} name
 * @param {Record<string, string>} said
 * @returns {string}
 */
export function getTextNow(name, said) {
  const request = new XMLHttpRequest();
  request.open("GET", `/api/${name}?${new URLSearchParams(said)}`, false);
  for (const [header, value] of Object.entries(withKey({}))) request.setRequestHeader(header, value);
  request.send();
  return request.status === 200 ? request.responseText : "";
}

/** @type {<M extends keyof Answers, N extends string & keyof Answers[M]>(method: M, name: N, said: Record<string, any>) => Promise<Answers[M][N]>} */
export const send = async (method, name, said) => (await ask(method, name, said)).json();

/**
 * Bring a file.
 * @param {string} name
 * @param {File} file
 * @returns {Promise<import("./answers.js").StoredFile>}
 */
export const bring = async (name, file) =>
  (await exchange(`files?${new URLSearchParams({ name })}`, {
    method: "POST",
    headers: { "Content-Type": "application/octet-stream" },
    body: file,
  })).json();

/**
 * Have the browser save a file; it fetches that by itself, from an address that counts once.
 * @param {"report" | "file"} name
 * @param {Record<string, string>} said
 */
export async function save(name, said) {
  const { ticket } = await send("POST", "ticket", { name, said });
  const link = document.createElement("a");
  link.href = `/api/ticket/${ticket}`;
  link.download = "";
  link.click();
}

/** Give the link's token for the key; without one, another window may tell it. */
export async function enter() {
  const token = /^#token=(.+)$/.exec(location.hash)?.[1];
  if (token) {
    // Neither the history nor a copied address keeps it.
    history.replaceState(null, "", "#/");
    const given = await send("POST", "session", { token }).catch(() => null);
    if (given) {
      sessionStorage.setItem(KEY, given.key);
      windows.postMessage({ key: given.key, renewed: true });
    }
  }
  if (sessionStorage.getItem(KEY)) return;
  await new Promise((told) => {
    windows.addEventListener("message", ({ data }) => data.key && told(undefined));
    windows.postMessage({ asked: true });
    setTimeout(told, PATIENCE);
  });
}
