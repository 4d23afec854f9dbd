{{- define "regnf.name" -}}
{{- printf "%s" .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- end -}}

{{- define "regnf.labels" -}}
app.kubernetes.io/name: regnf
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end -}}

{{- define "regnf.tag" -}}
{{- .Values.image.tag | default .Chart.AppVersion -}}
{{- end -}}

{{- define "regnf.podSecurity" -}}
runAsNonRoot: true
runAsUser: {{ . }}
runAsGroup: {{ . }}
fsGroup: {{ . }}
seccompProfile: {type: RuntimeDefault}
{{- end -}}

{{- define "regnf.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
{{- end -}}

{{/* What front end and workers are both told. */}}
{{- define "regnf.environment" -}}
- name: REGNF_REDIS_URL
  valueFrom: {secretKeyRef: {name: {{ .Values.redis.existingSecret | default (printf "%s-redis" (include "regnf.name" .)) }}, key: url}}
- name: REGNF_QUEUE_KEY
  valueFrom: {secretKeyRef: {name: {{ .Values.queue.existingSecret | default (printf "%s-queue" (include "regnf.name" .)) }}, key: key}}
- {name: REGNF_STATE_DIR, value: /var/lib/regnf}
- {name: REGNF_LOG_FORMAT, value: json}
{{- if eq .Values.storage.kind "s3" }}
- name: REGNF_STORAGE_URL
  value: {{ required "storage.s3.url is needed where storage.kind is s3" .Values.storage.s3.url | quote }}
{{- end }}
{{- range $name, $value := .Values.settings }}
- name: {{ $name }}
  value: {{ $value | quote }}
{{- end }}
{{- end -}}

{{- define "regnf.storageEnvironment" -}}
{{- if and (eq .Values.storage.kind "s3") .Values.storage.s3.existingSecret }}
envFrom:
  - secretRef: {name: {{ .Values.storage.s3.existingSecret }}}
{{- end }}
{{- end -}}

{{- define "regnf.stateVolume" -}}
- name: state
  {{- if eq .Values.storage.kind "volume" }}
  persistentVolumeClaim: {claimName: {{ .Values.storage.volume.existingClaim | default (printf "%s-state" (include "regnf.name" .)) }}}
  {{- else }}
  emptyDir: {sizeLimit: {{ .Values.storage.scratchSize }}}
  {{- end }}
- name: tmp
  emptyDir: {sizeLimit: 1Gi}
{{- end -}}

{{/* Under which names the front end is called: its services', the ingress' and those of the values. Probes use addresses. */}}
{{- define "regnf.allowedHosts" -}}
{{- $hosts := list -}}
{{- range list "api" "metrics" -}}
{{- $service := printf "%s-%s" (include "regnf.name" $) . -}}
{{- range list "" (printf ".%s" $.Release.Namespace) (printf ".%s.svc" $.Release.Namespace) (printf ".%s.svc.cluster.local" $.Release.Namespace) -}}
{{- $hosts = append $hosts (printf "%s%s" $service .) -}}
{{- end -}}
{{- end -}}
{{- if .Values.api.ingress.enabled -}}
{{- $hosts = append $hosts .Values.api.ingress.host -}}
{{- end -}}
{{- concat $hosts .Values.api.allowedHosts | uniq | toJson -}}
{{- end -}}
