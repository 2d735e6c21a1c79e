{{/* Name of everything in this release. */}}
{{- define "rayfix.name" -}}
{{- $name := contains "rayfix" .Release.Name | ternary .Release.Name (printf "%s-rayfix" .Release.Name) -}}
{{ $name | trunc 40 | trimSuffix "-" }}
{{- end }}

{{/* Labels that select; a part is added by each user. */}}
{{- define "rayfix.selector" -}}
app.kubernetes.io/name: rayfix
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end }}

{{- define "rayfix.labels" -}}
{{ include "rayfix.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ .Chart.Name }}-{{ .Chart.Version }}
{{- end }}

{{/* Reference of an image: call with a list of the context and an entry of .Values.images. */}}
{{- define "rayfix.image" -}}
{{- $context := index . 0 }}{{ $image := index . 1 -}}
{{- if $image.digest -}}
{{ $image.repository }}@{{ $image.digest }}
{{- else -}}
{{ $image.repository }}:{{ $image.tag | default $context.Chart.AppVersion }}
{{- end }}
{{- end }}

{{/* What decides the table: a change of it makes a new job, a new file and a rollout. */}}
{{- define "rayfix.revision" -}}
{{- if eq .Values.table.source "url" -}}
{{ .Values.table.id | trunc 12 }}
{{- else -}}
{{- /* Addresses of files do not count, as signed ones change; their hashes do. */}}
{{- $files := list -}}
{{- range .Values.site.files }}{{ $files = append $files (list .name .sha256) }}{{ end -}}
{{- $site := merge (dict "files" $files) (omit .Values.site "files") -}}
{{ printf "%s %s" (toJson $site) (include "rayfix.image" (list . .Values.images.offline)) | sha256sum | trunc 12 }}
{{- end }}
{{- end }}

{{- define "rayfix.tableFile" -}}
site-{{ include "rayfix.revision" . }}.h5
{{- end }}

{{- define "rayfix.claim" -}}
{{ .Values.table.claim.existing | default (printf "%s-tables" (include "rayfix.name" .)) }}
{{- end }}

{{- define "rayfix.podSecurity" -}}
runAsNonRoot: true
runAsUser: 10001
runAsGroup: 10001
fsGroup: 10001
seccompProfile: {type: RuntimeDefault}
{{- end }}

{{- define "rayfix.containerSecurity" -}}
readOnlyRootFilesystem: true
allowPrivilegeEscalation: false
capabilities: {drop: [ALL]}
{{- end }}

{{/* Rule of a network policy: names may be looked up. */}}
{{- define "rayfix.nameLookups" -}}
- ports:
    - {port: 53, protocol: UDP}
    - {port: 53, protocol: TCP}
{{- end }}

{{/* Port of an address: call with a URL. */}}
{{- define "rayfix.portOf" -}}
{{- $url := urlParse . -}}
{{- $named := regexFind ":[0-9]+$" $url.host | trimPrefix ":" -}}
{{- $usual := dict "https" "443" "http" "80" "tcp" "8786" "tls" "8786" -}}
{{ $named | default (get $usual $url.scheme) | default "443" }}
{{- end }}
