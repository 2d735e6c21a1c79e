/** What `rayfix view` put into the page, if it did. */

import type { EmbeddedData } from "./types";

export const DATA_ELEMENT = "rayfix-data";

export function embeddedData(): EmbeddedData | null {
  const element = document.getElementById(DATA_ELEMENT);
  return element === null ? null : (JSON.parse(element.textContent) as EmbeddedData);
}

export function decodeBase64(text: string): ArrayBuffer {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let n = 0; n < binary.length; n++) bytes[n] = binary.charCodeAt(n);
  return bytes.buffer;
}
