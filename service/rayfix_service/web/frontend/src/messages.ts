/** What a person pastes: a report, a batch, or a message of another system, and where it is posted. */

export interface Posting {
  path: string;
  contentType: "application/json" | "text/plain";
  /** The report itself, where the message is one; else the answer has what it was turned into. */
  report: unknown;
  body: string;
}

const NRPPA_KEYS = [
  "TRP-MeasurementResponseList",
  "TRP-MeasurementReportList",
  "initiatingMessage",
  "successfulOutcome",
  "unsuccessfulOutcome",
];

/** Tell by its form what a text is; throws for what is neither JSON nor lines of u-blox anchors. */
export function postingOf(text: string): Posting {
  if (/^[^\n{[]*\+UUDF:/m.test(text)) {
    return { path: "v1/positions/ublox?with_report=true", contentType: "text/plain", report: null, body: text };
  }
  let document: unknown;
  try {
    document = JSON.parse(text);
  } catch (error) {
    throw new Error(`This is neither JSON nor has it lines with +UUDF: – ${(error as Error).message}`, { cause: error });
  }
  const batch = isObject(document) && Array.isArray(document.reports) ? (document.reports as unknown[]) : null;
  const format = formatOf(batch === null ? document : batch[0]);
  const path = ["v1/positions", format, batch === null ? null : "batch"].filter((part) => part !== null).join("/");
  return {
    path: format === null ? path : `${path}?with_report=true`,
    contentType: "application/json",
    report: format === null ? document : null,
    body: text,
  };
}

function formatOf(document: unknown): "nrppa" | "silabs" | null {
  if (!isObject(document)) return null;
  if (NRPPA_KEYS.some((key) => key in document)) return "nrppa";
  return "angles" in document ? "silabs" : null;
}

const isObject = (value: unknown): value is Record<string, unknown> =>
  typeof value === "object" && value !== null && !Array.isArray(value);
