import js from "@eslint/js";
import { defineConfig } from "eslint/config";
import tseslint from "typescript-eslint";

export default defineConfig(
  js.configs.recommended,
  tseslint.configs.recommendedTypeChecked,
  { languageOptions: { parserOptions: { projectService: { allowDefaultProject: ["eslint.config.js"] } } } },
  {
    rules: {
      eqeqeq: ["error", "always", { null: "ignore" }],
      "no-constant-condition": "error",
      "prefer-const": "error",
      // "!" marks indices that are within their arrays.
      "@typescript-eslint/no-non-null-assertion": "off",
    },
  },
);
