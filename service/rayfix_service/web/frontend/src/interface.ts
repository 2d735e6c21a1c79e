// The page that shows the OpenAPI document and asks the service by it. Everything comes from the service itself.
import SwaggerUI from "swagger-ui-dist/swagger-ui-es-bundle.js";
import licences from "swagger-ui-dist/swagger-ui-es-bundle.js.LICENSE.txt?url";
import "swagger-ui-dist/swagger-ui.css";
import "./style/interface.css";

import { theme } from "./theme";

// Dark or light as the viewer is; Swagger UI has the colours of both.
const paint = (): void => void document.documentElement.classList.toggle("dark-mode", theme.name === "dark");
theme.onChange(paint);
paint();

SwaggerUI({
  dom_id: "#interface",
  url: "openapi.json",
  deepLinking: true,
  validatorUrl: null, // else documents of public addresses are sent to a service of others
});
document.querySelector("#licences")!.setAttribute("href", licences);
