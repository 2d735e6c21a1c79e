import { defineConfig } from "vite";

// The page of the HTTP interface, beside the viewer and built after it: nothing of it goes into the viewer's one script.
export default defineConfig({
  base: "./",
  build: {
    outDir: "../static",
    emptyOutDir: false,
    assetsDir: "interface",
    target: "es2022",
    modulePreload: false,
    assetsInlineLimit: 0,
    chunkSizeWarningLimit: 2000,
    license: { fileName: "third-party-licences-interface.md" },
    rolldownOptions: { input: "interface.html" },
  },
});
