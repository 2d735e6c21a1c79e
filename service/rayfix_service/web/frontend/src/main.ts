/** Loads the site from the service, or from the page itself, and starts the viewer. */

import "./style/base.css";
import "./style/drawing.css";
import "./style/panels.css";
import "./style/details.css";
import "./style/screens.css";

import { Api, ServiceError } from "./api";
import { decodeBase64, embeddedData } from "./embedded";
import { recordingOf } from "./recording";
import { readGlb } from "./scene/glb";
import { Stage } from "./scene/stage";
import type { Mesh, Site, TableInfo } from "./types";
import { buildLayout } from "./ui/layout";
import { StatusScreen } from "./ui/status";
import { Viewer } from "./viewer";

declare global {
  interface Window {
    /** For tests and curious people: the running viewer. */
    rayfixViewer?: Viewer;
  }
}

const WAIT = 1000; // ms until a service that is not ready is asked again

/** Name of the table in the page's address, where a service has several. */
const chosenTable = (): string | null => new URLSearchParams(location.hash.slice(1)).get("table");

async function load(api: Api, status: StatusScreen): Promise<[Site, Mesh, TableInfo[]]> {
  for (;;) {
    try {
      const tables = await api.tables();
      const table = tables.find((t) => t.name === chosenTable()) ?? tables[0]!;
      api.table = table.name;
      const [stations, settings, scene] = await Promise.all([
        api.stations(),
        api.settings(),
        api.scene(),
      ]);
      return [{ table, stations, settings }, readGlb(scene), tables];
    } catch (error) {
      const known = error instanceof ServiceError ? error : null;
      if (known?.status === 401) {
        api.setKey(await status.askKey(api.hasKey));
        status.loading("Loading the scene …");
      } else if (known?.status === 503 && known.retryAfter !== null) {
        status.loading("The service checks its table and compiles its kernels …");
        await new Promise((resolve) => setTimeout(resolve, WAIT));
      } else {
        await status.failed("The site cannot be shown", known?.message ?? String(error));
        status.loading("Loading the scene …");
      }
    }
  }
}

async function start(): Promise<void> {
  const root = document.getElementById("app")!;
  const layout = buildLayout(root);
  const status = new StatusScreen(root);
  status.loading("Loading the scene …");
  let stage: Stage;
  try {
    stage = new Stage(layout.canvas, layout.labels);
  } catch {
    await status.failed("No WebGL", "This browser cannot draw in three dimensions; allow WebGL 2 or take another one.");
    location.reload();
    return;
  }
  const embedded = embeddedData();
  if (embedded !== null) {
    const viewer = new Viewer(layout, stage, embedded, readGlb(decodeBase64(embedded.scene_base64)), null);
    viewer.streamState("file");
    for (const event of embedded.events) viewer.store.add(event);
    if (embedded.recording) viewer.play(recordingOf(embedded.recording.name, embedded.recording.events));
    window.rayfixViewer = viewer;
    status.done();
    return;
  }
  const api = new Api();
  const [site, mesh, tables] = await load(api, status);
  const viewer = new Viewer(layout, stage, site, mesh, api);
  viewer.offerTables(tables);
  window.rayfixViewer = viewer;
  status.done();
  performance.mark("rayfix-ready");
  void api.listen(
    (event) => viewer.receive(event),
    (state) => viewer.streamState(state),
  );
}

void start();
