// The points are drawn as small lit discs that lie in the surface, so that a cloud reads as the thing it samples.

export const VERTEX = /* glsl */ `
  uniform float uWorldSize;   // diameter of a disc in the cloud's own units
  uniform float uPixels;      // pixels a unit length covers at distance one
  uniform float uMinPixels;
  uniform int uMode;          // 0 one tint, 1 the ramp, 2 the file's colors
  uniform vec3 uTint;
  uniform vec3 uRamp[5];
  uniform bool uLit;
  uniform bool uSeeThrough;   // leave out what is seen from inside matter: walls seen from behind
  uniform float uNearer;      // towards the camera, in discs: which of two surfaces in one place is seen
  attribute float aValue;     // 0..1 along the ramp
  attribute vec3 aColor;
  varying vec3 vColor;
  varying vec3 vNormal;

  vec3 ramp(float share) {
    float at = clamp(share, 0.0, 1.0) * 4.0;
    vec3 color = uRamp[0];
    for (int i = 0; i < 4; i++) color = mix(color, uRamp[i + 1], clamp(at - float(i), 0.0, 1.0));
    return color;
  }

  void main() {
    vec4 view = modelViewMatrix * vec4(position, 1.0);
    float scale = length(modelMatrix[0].xyz);
    vec3 base = uMode == 1 ? ramp(aValue) : (uMode == 2 ? aColor : uTint);
    vNormal = vec3(0.0, 0.0, 1.0);
    vColor = base;
    if (uLit) {
      vNormal = normalize(normalMatrix * normal);
      vec3 eye = normalize(-view.xyz);
      float facing = dot(vNormal, eye);
      float key = max(dot(vNormal, normalize(vec3(0.45, 0.75, 0.6))), 0.0);
      float fill = max(dot(vNormal, normalize(vec3(-0.7, 0.1, 0.5))), 0.0);
      float rim = pow(1.0 - max(facing, 0.0), 3.0);
      float light = 0.64 + 0.40 * key + 0.12 * fill;
      vColor = base * (facing < 0.0 ? 0.5 : light) + 0.06 * rim * step(0.0, facing);
      if (facing < 0.0) vNormal = -vNormal;
    }
    gl_Position = projectionMatrix * view;
    vec4 nearer = projectionMatrix * (view + vec4(0.0, 0.0, uNearer * uWorldSize * scale, 0.0));
    gl_Position.z = nearer.z / nearer.w * gl_Position.w;
    if (uLit && uSeeThrough && dot(normalize(normalMatrix * normal), normalize(-view.xyz)) < -0.1) {
      gl_Position = vec4(2.0, 2.0, 2.0, 1.0);   // outside the view
    }
    gl_PointSize = clamp(uWorldSize * scale * uPixels / -view.z, uMinPixels, 64.0);
  }
`;

export const FRAGMENT = /* glsl */ `
  uniform float uOpacity;
  varying vec3 vColor;
  varying vec3 vNormal;

  void main() {
    vec2 at = gl_PointCoord * 2.0 - 1.0;
    at.y = -at.y;
    vec3 n = normalize(vNormal);
    float depth = -dot(n.xy, at) / max(n.z, 0.3);   // where the disc's plane lies under this pixel
    float reach = dot(at, at) + depth * depth;
    if (reach > 1.0) discard;
    gl_FragColor = vec4(vColor, uOpacity);
  }
`;
