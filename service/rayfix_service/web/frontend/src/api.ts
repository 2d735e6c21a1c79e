/** Talks to the service that gave the page, and to nothing else. */

import type { Posting } from "./messages";
import type {
  Coverage,
  Fix,
  FixEvent,
  MixtureView,
  Posterior,
  Report,
  StationInfo,
  TableInfo,
  Vec3,
  ViewerSettings,
} from "./types";

const KEY = "rayfix-api-key";
const RETRY = 2000; // ms
const TABLES = "v1/tables"; // the only path that takes no name of a table

interface Problem {
  title: string;
  detail: string;
  errors?: { path: string; message: string }[];
}

/** An answer that is no success; its message is for people. */
export class ServiceError extends Error {
  constructor(
    message: string,
    readonly status: number,
    readonly retryAfter: number | null = null,
  ) {
    super(message);
  }
}

export type StreamState = "live" | "connecting" | "absent" | "refused";

export interface Simulated {
  report: Report;
  fix: Fix;
}

export class Api {
  private key: string | null = session()?.getItem(KEY) ?? null;

  get hasKey(): boolean {
    return this.key !== null;
  }

  setKey(key: string): void {
    this.key = key;
    session()?.setItem(KEY, key);
  }

  /** The table that is asked of, once one is chosen. */
  table: string | null = null;

  tables = async (): Promise<TableInfo[]> => (await this.json<{ tables: TableInfo[] }>(TABLES)).tables;

  stations = async (): Promise<StationInfo[]> =>
    (await this.json<{ stations: StationInfo[] }>("v1/stations")).stations;

  settings = (): Promise<ViewerSettings> => this.json("v1/viewer");

  scene = async (): Promise<ArrayBuffer> => (await this.fetch("v1/scene.glb")).arrayBuffer();

  /** Post a report or another system's message; gives each fix with its report, and what was wrong with others. */
  async locate(posting: Posting): Promise<{ located: Simulated[]; problems: string[] }> {
    const init = { method: "POST", headers: { "content-type": posting.contentType }, body: posting.body };
    const answer = await this.json<Fix | { results: (Fix | Problem)[] }>(posting.path, init);
    if (!("results" in answer)) return { located: [withReport(answer, posting.report)], problems: [] };
    const reports = (posting.report as { reports?: unknown[] } | null)?.reports;
    const located: Simulated[] = [];
    const problems: string[] = [];
    answer.results.forEach((one, n) => {
      if ("errors" in one) problems.push(`${n + 1}: ${one.detail}`);
      else located.push(withReport(one as Fix, reports?.[n]));
    });
    return { located, problems };
  }

  posterior = (report: Report, signal: AbortSignal): Promise<Posterior> => this.post("v1/posteriors", report, signal);

  coverage = (id: string): Promise<Coverage> => this.json(`v1/stations/${encodeURIComponent(id)}/coverage`);

  simulate(position: Vec3, options: Record<string, unknown>): Promise<Simulated> {
    return this.post("v1/simulations", { position, ...options });
  }

  mixture(id: string, azimuth: number, zenith: number, stdev: number, signal: AbortSignal): Promise<MixtureView> {
    const query = new URLSearchParams({
      azimuth_deg: String(azimuth),
      zenith_deg: String(zenith),
      stdev_deg: String(stdev),
    });
    return this.json(`v1/stations/${encodeURIComponent(id)}/mixture?${query}`, { signal });
  }

  /** Listen to all fixes until the page ends; server-sent events, read by fetch, which can send a key. */
  async listen(onFix: (event: FixEvent) => void, onState: (state: StreamState) => void): Promise<void> {
    for (;;) {
      onState("connecting");
      try {
        const response = await this.fetch("v1/fixes");
        onState("live");
        for await (const { event, data } of events(response)) {
          if (event !== "fix") continue;
          const { table, report, fix } = JSON.parse(data) as { table: string; report: Report; fix: Fix };
          if (table === this.table) onFix({ report, fix, source: "stream" });
        }
      } catch (error) {
        if (error instanceof ServiceError && [401, 403, 404].includes(error.status)) {
          onState(error.status === 404 ? "absent" : "refused");
          return;
        }
      }
      onState("connecting");
      await new Promise((resolve) => setTimeout(resolve, RETRY));
    }
  }

  private async json<T>(path: string, init: RequestInit = {}): Promise<T> {
    return (await this.fetch(path, init)).json() as Promise<T>;
  }

  private post<T>(path: string, document: unknown, signal?: AbortSignal): Promise<T> {
    const init: RequestInit = {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(document),
    };
    return this.json(path, signal ? { ...init, signal } : init);
  }

  private async fetch(path: string, init: RequestInit = {}): Promise<Response> {
    const headers = new Headers(init.headers);
    if (this.key !== null) headers.set("Authorization", `Bearer ${this.key}`);
    let response: Response;
    const url = new URL(path, location.href);
    if (this.table !== null && path !== TABLES) url.searchParams.set("table", this.table);
    try {
      response = await fetch(url, { ...init, headers });
    } catch (error) {
      if (error instanceof DOMException) throw error; // given up by the viewer itself
      throw new ServiceError("The service does not answer. Is it running?", 0);
    }
    if (response.ok) return response;
    const retry = Number(response.headers.get("retry-after")) || null;
    throw new ServiceError(await problemText(response), response.status, retry);
  }
}

/** The report of a fix: the one that was posted, or what the service turned the message into. */
function withReport(fix: Fix & { report?: Report }, posted: unknown): Simulated {
  return { report: fix.report ?? (posted as Report), fix };
}

async function problemText(response: Response): Promise<string> {
  try {
    const problem = (await response.json()) as Problem;
    return problem.errors?.length ? problem.errors.map((e) => e.message).join("\n") : problem.detail;
  } catch {
    return `The service answered ${response.status} ${response.statusText}.`;
  }
}

/** Events of a stream, as the HTML standard's section on server-sent events defines them. */
async function* events(response: Response): AsyncGenerator<{ event: string; data: string }> {
  const reader = response.body!.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    const blocks = text.split(/\r?\n\r?\n/);
    text = blocks.pop()!;
    for (const block of blocks) {
      let event = "message";
      const data: string[] = [];
      for (const line of block.split(/\r?\n/)) {
        const colon = line.indexOf(":");
        const field = colon < 0 ? line : line.slice(0, colon);
        const content = line.slice(colon + 1).replace(/^ /, "");
        if (field === "event") event = content;
        else if (field === "data") data.push(content);
      }
      if (data.length) yield { event, data: data.join("\n") };
    }
  }
}

function session(): Storage | null {
  try {
    return sessionStorage;
  } catch {
    return null; // a page from a file
  }
}
