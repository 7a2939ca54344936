// Everything that the page asks its server for.

const PATIENCE_MS = 20000; // for the answer to a change
const AGAIN_MS = 2000; // before a stream that the browser has given up is opened anew

export async function get(path) {
  const answer = await fetch(path, { headers: { Accept: "application/json" } });
  const found = await answer.json().catch(() => ({})); // a proxy's error page is no JSON
  if (!answer.ok) throw new Error(found.error || `${path} was answered with ${answer.status}`);
  return found;
}

export class Refused extends Error {
  constructor(message, status, found = {}) {
    super(message);
    Object.assign(this, { status, needs: found.needs, unproven: found.unproven, entry: found.entry });
  }
}

export async function change(wanted, token) {
  let answer, found;
  try {
    answer = await fetch("/api/change", {
      method: "POST",
      headers: { "Content-Type": "application/json", Authorization: `Bearer ${token}` },
      body: JSON.stringify(wanted),
      signal: AbortSignal.timeout(PATIENCE_MS),
    });
    found = await answer.json();
  } catch {
    // The request may have reached the loop all the same.
    throw new Error('No answer came. It may have been done or not: look at the mode, the values and "What happened".');
  }
  if (!answer.ok || found.error) throw new Refused(found.error || answer.statusText, answer.status, found);
  return found.done;
}

// Courses after {changes: by name} or with {course: to come}; it changes nothing, so it needs no token.
export async function foresee(body) {
  const answer = await fetch("/api/what-if", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
    signal: AbortSignal.timeout(PATIENCE_MS),
  });
  const found = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Refused(found.error || answer.statusText, answer.status, found);
  return found;
}

// Server-sent events. The browser connects again by itself, but not after an answer that is no stream (a proxy's 502).
export function listen(handlers, lost, found) {
  const stream = new EventSource("/api/live");
  for (const [name, handle] of Object.entries(handlers)) {
    stream.addEventListener(name, (event) => {
      found();
      handle(JSON.parse(event.data));
    });
  }
  stream.onerror = () => {
    lost();
    if (stream.readyState === EventSource.CLOSED) setTimeout(() => listen(handlers, lost, found), AGAIN_MS);
  };
  stream.onopen = found;
}
