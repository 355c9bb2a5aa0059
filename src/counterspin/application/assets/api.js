// @ts-check
// What the page asks the server; every request goes to the server that the page came from.

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
  let response;
  try {
    response = await fetch(`/api/${name}${query}`, {
      method,
      headers: reading ? {} : { "Content-Type": "application/json" },
      body: reading ? undefined : JSON.stringify(given),
    });
  } catch {
    throw new Refused(0, { error: "The server does not answer; was it ended?" });
  }
  if (response.ok) return response;
  const told = await response.json().catch(() => ({ error: `The server answers ${response.status}.` }));
  throw new Refused(response.status, told);
}

/** @type {(name: string, said?: Record<string, any>) => Promise<any>} */
export const get = async (name, said) => (await ask("GET", name, said)).json();

/** @type {(name: string, said?: Record<string, any>) => Promise<string>} */
export const getText = async (name, said) => (await ask("GET", name, said)).text();

/** @type {(method: string, name: string, said: Record<string, any>) => Promise<any>} */
export const send = async (method, name, said) => (await ask(method, name, said)).json();

/**
 * Give the link's token for the cookie; nothing to do where there is none.
 */
export async function enter() {
  const token = /^#token=(.+)$/.exec(location.hash)?.[1];
  if (!token) return;
  // Neither the history nor a copied address keeps it.
  history.replaceState(null, "", "#/");
  await fetch("/api/session", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ token }),
  });
}
