import { describe, expect, it } from "vitest";

import { postingOf } from "../src/messages";

const paths = (document: unknown): string => postingOf(JSON.stringify(document)).path;

describe("a pasted text", () => {
  it("is a report or a batch of reports", () => {
    const report = { measurements: [] };
    expect(postingOf(JSON.stringify(report))).toMatchObject({ path: "v1/positions", report });
    expect(paths({ reports: [report] })).toBe("v1/positions/batch");
    expect(paths([1])).toBe("v1/positions");
  });

  it("is a message of another system, by its keys", () => {
    expect(paths({ "TRP-MeasurementResponseList": [] })).toBe("v1/positions/nrppa?with_report=true");
    expect(paths({ successfulOutcome: {} })).toBe("v1/positions/nrppa?with_report=true");
    expect(paths({ angles: [] })).toBe("v1/positions/silabs?with_report=true");
    expect(paths({ reports: [{ angles: [] }] })).toBe("v1/positions/silabs/batch?with_report=true");
  });

  it("is lines of u-blox anchors, also behind a log's time", () => {
    const lines = 'OK\n12:00:01 +UUDF:6C1DEBA5F60C,-53,15,-6,0,37,"bs1","",1437347,40871\n';
    expect(postingOf(lines)).toEqual({
      path: "v1/positions/ublox?with_report=true",
      contentType: "text/plain",
      report: null,
      body: lines,
    });
  });

  it("is none of them", () => {
    expect(() => postingOf("hello")).toThrow("neither JSON nor");
  });

  it("is JSON where the mark of lines is within it", () => {
    expect(paths({ target_id: "+UUDF:", measurements: [] })).toBe("v1/positions");
  });
});
