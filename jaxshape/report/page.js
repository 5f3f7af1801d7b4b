// Turns the shape, the grids and the cameras of a report, in WebGL 2, without a library.
//
// The object frame is shown: metres, +y up. Angles are those of the pictures: azimuth 0 looks at
// the object's front and grows towards its +x side, elevation grows upwards, in degrees.
// Drag to turn, Shift or right button or two fingers to shift, wheel or pinch to zoom.
"use strict";

const canvas = document.getElementById("turnable");
const scene = JSON.parse(document.getElementById("scene").textContent);
const gl = canvas?.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true }); // to print

const HOME = { azimuth: 35, elevation: 25, distance: 3.4 * scene.radius, target: scene.center };
const FOCAL = 2.2; // half the height of the picture is 1
const eye = structuredClone(HOME);

// ---------------------------------------------------------------- geometry

const bytes = (base64) => Uint8Array.from(atob(base64), (c) => c.charCodeAt(0)).buffer;

const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];

/** Triangles of an indexed mesh, with the normals of its vertices. */
function meshGeometry(layer) {
  const vertices = new Float32Array(bytes(layer.vertices));
  const faces = new Uint32Array(bytes(layer.faces));
  const normals = new Float32Array(vertices.length);
  const point = (i) => vertices.subarray(3 * i, 3 * i + 3);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [point(faces[f]), point(faces[f + 1]), point(faces[f + 2])];
    const normal = cross(b.map((x, i) => x - a[i]), c.map((x, i) => x - a[i])); // weighs by area
    for (let k = 0; k < 3; k++)
      for (let i = 0; i < 3; i++) normals[3 * faces[f + k] + i] += normal[i];
  }
  const gather = (from) => Float32Array.from({ length: 3 * faces.length },
    (_, i) => from[3 * faces[Math.floor(i / 3)] + (i % 3)]);
  const paint = layer.paints[layer.paint];
  const colors = paint && gather(new Uint8Array(bytes(paint))).map((part) => part / 255);
  return { positions: gather(vertices), normals: gather(normals), colors };
}

/** The faces of a grid's voxels that lie open, in voxel coordinates; bits are indexed [x, y, z]. */
function voxelGeometry(layer) {
  const packed = new Uint8Array(bytes(layer.voxels));
  const shape = scene.shape;
  const filled = (v) => {
    if (v.some((x, i) => x < 0 || x >= shape[i])) return 0;
    const bit = (v[0] * shape[1] + v[1]) * shape[2] + v[2];
    return (packed[bit >> 3] >> (7 - (bit & 7))) & 1;
  };
  const positions = [], normals = [];
  const corners = [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]];
  const face = (voxel, axis, sign) => {
    const normal = [0, 0, 0];
    normal[axis] = sign;
    if (filled(voxel.map((x, i) => x + normal[i]))) return;
    for (const [s, t] of corners) {
      const corner = [...voxel];
      corner[axis] += sign > 0;
      corner[(axis + 1) % 3] += s;
      corner[(axis + 2) % 3] += t;
      positions.push(...corner);
      normals.push(...normal);
    }
  };
  for (let x = 0; x < shape[0]; x++)
    for (let y = 0; y < shape[1]; y++)
      for (let z = 0; z < shape[2]; z++)
        if (filled([x, y, z]))
          for (let axis = 0; axis < 3; axis++)
            for (const sign of [-1, 1]) face([x, y, z], axis, sign);
  return { positions: new Float32Array(positions), normals: new Float32Array(normals) };
}

function lineGeometry(layer) {
  const positions = new Float32Array(bytes(layer.lines));
  return { positions, normals: new Float32Array(positions.length) }; // without light
}

// ---------------------------------------------------------------- drawing

const VERTEX = `#version 300 es
in vec3 position, normal, paint;
uniform mat4 clip_from_object;
uniform mat3 view;
uniform vec3 origin, scale;
out vec3 place, facing, painted;
void main() {
  painted = paint;
  place = position;
  facing = view * (normal / scale);
  gl_Position = clip_from_object * vec4(origin + scale * position, 1.0);
}`;

// The light and the dark edges of pictures.py.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 place, facing, painted;
uniform vec4 color;
uniform bool voxels, is_painted;
out vec4 shown;
void main() {
  float brightness = 1.0;
  if (dot(facing, facing) > 0.0) {
    vec3 n = normalize(facing) * (facing.z < 0.0 ? -1.0 : 1.0);
    brightness = 0.62 + 0.38 * max(dot(n, normalize(vec3(-0.35, 0.8, 0.5))), 0.0);
  }
  if (voxels) {
    vec3 border = abs(fract(place + 1e-4) - 0.5);  // 0.5 along the normal
    float second = max(min(border.x, border.y), min(max(border.x, border.y), border.z));
    if (second > 0.44) brightness *= 0.86;
  }
  vec3 base = is_painted ? painted : color.rgb;
  shown = vec4(base * brightness * color.a, color.a);
}`;

function compile() {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  return program;
}

/** Hand a layer's geometry to the graphics card, when it is first shown. */
function upload(program, layer) {
  const make = layer.lines ? lineGeometry : layer.voxels ? voxelGeometry : meshGeometry;
  const geometry = make(layer);
  layer.count = geometry.positions.length / 3;
  layer.array = gl.createVertexArray();
  gl.bindVertexArray(layer.array);
  const data_of = { position: geometry.positions, normal: geometry.normals, paint: geometry.colors };
  for (const [name, data] of Object.entries(data_of)) {
    if (!data) continue;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    const place = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 0, 0);
  }
}

/** Unit vectors to the right, up and towards the viewer. */
function view() {
  const [a, e] = [eye.azimuth, eye.elevation].map((degrees) => (degrees * Math.PI) / 180);
  const towards = [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
  const right = [Math.cos(a), 0, -Math.sin(a)];
  return [right, cross(towards, right), towards];
}

/** OpenGL's perspective of the view, column after column. */
function clipFromObject([right, up, towards]) {
  const aspect = canvas.width / canvas.height;
  const focal = FOCAL * Math.min(1, aspect);
  const [near, far] = [eye.distance / 100, eye.distance + 100 * scene.radius];
  const shift = (axis) => -axis.reduce((sum, x, i) => sum + x * eye.target[i], 0);
  const z = [...towards, shift(towards) - eye.distance];
  const rows = [
    [...right, shift(right)].map((x) => (x * focal) / aspect),
    [...up, shift(up)].map((x) => x * focal),
    z.map((x, i) => (-x * (far + near) - (i === 3) * 2 * far * near) / (far - near)),
    z.map((x) => -x),
  ];
  return [0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column]));
}

function draw(program) {
  const set = (name) => gl.getUniformLocation(program, name);
  const axes = view();
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clearColor(1, 1, 1, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.uniformMatrix4fv(set("clip_from_object"), false, clipFromObject(axes));
  gl.uniformMatrix3fv(set("view"), false, [0, 1, 2].flatMap((c) => axes.map((axis) => axis[c])));
  const solidFirst = [...scene.layers].sort((a, b) => b.opacity - a.opacity);
  for (const layer of solidFirst.filter((layer) => layer.shown)) {
    if (!layer.array) upload(program, layer);
    const color = [1, 3, 5].map((i) => parseInt(layer.color.slice(i, i + 2), 16) / 255);
    gl.uniform4f(set("color"), ...color, layer.opacity);
    gl.uniform1i(set("voxels"), Boolean(layer.voxels));
    gl.uniform1i(set("is_painted"), Boolean(layer.paints?.[layer.paint]));
    gl.uniform3fv(set("origin"), layer.voxels ? scene.origin : [0, 0, 0]);
    gl.uniform3fv(set("scale"), layer.voxels ? scene.voxel_size : [1, 1, 1]);
    gl.depthMask(layer.opacity === 1);
    gl.bindVertexArray(layer.array);
    gl.drawArrays(layer.lines ? gl.LINES : gl.TRIANGLES, 0, layer.count);
  }
  gl.depthMask(true);
}

// ---------------------------------------------------------------- hands

function turn(dx, dy) {
  eye.azimuth -= dx;
  eye.elevation = Math.max(-89, Math.min(89, eye.elevation + dy));
}

function shift(dx, dy) {
  const [right, up] = view();
  const metres = (2 * eye.distance) / (FOCAL * Math.min(canvas.clientHeight, canvas.clientWidth));
  eye.target = eye.target.map((x, i) => x + metres * (dy * up[i] - dx * right[i]));
}

function zoom(factor) {
  const [least, most] = [0.2 * scene.radius, 40 * scene.radius];
  eye.distance = Math.max(least, Math.min(most, eye.distance * factor));
}

function listen(redraw) {
  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const apart = fingers.size === 2 && spread();
    const [dx, dy] = [event.clientX - before.x, event.clientY - before.y];
    Object.assign(before, { x: event.clientX, y: event.clientY });
    if (fingers.size === 2) {
      shift(dx / 2, dy / 2);
      zoom(apart / Math.max(1, spread()));
    } else if (event.shiftKey || event.buttons === 2) shift(dx, dy);
    else turn(0.4 * dx, 0.4 * dy);
    redraw();
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return; // the page scrolls until the picture is taken up
    event.preventDefault();
    zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
    redraw();
  }, { passive: false });
  const keys = {
    ArrowLeft: () => turn(-8, 0), ArrowRight: () => turn(8, 0),
    ArrowUp: () => turn(0, 8), ArrowDown: () => turn(0, -8),
    "+": () => zoom(0.9), "-": () => zoom(1 / 0.9),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
    redraw();
  });
  for (const button of document.querySelectorAll("[data-view]"))
    button.addEventListener("click", () => {
      const [azimuth, elevation] = button.dataset.view.split(" ").map(Number);
      Object.assign(eye, structuredClone(HOME), { azimuth, elevation });
      redraw();
    });
  for (const box of document.querySelectorAll("[data-layer]")) {
    const layer = scene.layers.find((layer) => layer.name === box.dataset.layer);
    box.checked = layer.shown; // browsers remember boxes over a reload
    box.addEventListener("change", () => {
      layer.shown = box.checked;
      redraw();
    });
  }
  const choice = document.getElementById("paint");
  choice?.addEventListener("change", () => {
    const mesh = scene.layers.find((layer) => layer.name === "mesh");
    mesh.paint = choice.value;
    mesh.array = null; // handed over anew
    redraw();
  });
}

function start() {
  for (const layer of scene.layers.filter((layer) => layer.paints))
    layer.paint = document.getElementById("paint")?.value;
  const program = compile();
  let asked = false;
  const redraw = () => {
    if (!asked) requestAnimationFrame(() => { asked = false; draw(program); });
    asked = true;
  };
  listen(redraw);
  new ResizeObserver(() => {
    canvas.width = canvas.clientWidth * devicePixelRatio;
    canvas.height = canvas.clientHeight * devicePixelRatio;
    draw(program); // at once: a canvas that changed its size is empty
  }).observe(canvas);
  document.getElementById("shape").classList.add("live"); // instead of the picture
}

if (gl) start();
