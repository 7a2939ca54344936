// The files of the case: beside the page on a file server, or packed into the page itself.
const packed = document.getElementById("files");
const inside = packed ? JSON.parse(packed.textContent) : {};

export async function read(name) {
  if (name in inside) return unpacked(inside[name]);
  let answer;
  try {
    answer = await fetch(name, { cache: "no-cache" });
  } catch {
    throw new Error(`${name} cannot be read: the file server does not answer`);
  }
  if (!answer.ok) throw new Error(`${name} cannot be read: the file server says ${answer.status} ${answer.statusText}`);
  return new Uint8Array(await answer.arrayBuffer());
}

export const has = (name) => name in inside;

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
