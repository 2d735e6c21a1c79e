declare module "swagger-ui-dist/swagger-ui-es-bundle.js" {
  const SwaggerUI: (options: {
    dom_id: string;
    url: string;
    deepLinking: boolean;
    validatorUrl: string | null;
  }) => void;
  export default SwaggerUI;
}
