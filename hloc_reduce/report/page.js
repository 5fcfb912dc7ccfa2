"use strict";
(() => {
  const byId = (id) => document.getElementById(id);

  // the table of queries: sorted by column, filtered by run and name
  const body = byId("table").tBodies[0];
  const rows = [...body.rows];
  const heads = [...byId("table").tHead.rows[0].cells];

  function sort(column) {
    const head = heads[column];
    const ascending = head.getAttribute("aria-sort") !== "ascending";
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    const numbers = head.dataset.sort === "number";
    const value = (row) => {
      const text = row.cells[column].textContent;
      if (!numbers) return text;
      return text === "" || text === "none" ? Infinity : Number(text);
    };
    const sign = ascending ? 1 : -1;
    const compare = (a, b) => (numbers ? (a === b ? 0 : a - b) : a.localeCompare(b));
    rows.sort((a, b) => sign * compare(value(a), value(b)));
    body.append(...rows);
  }
  heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => sort(column)));

  function filter() {
    const run = byId("only").value;
    const part = byId("name").value.toLowerCase();
    let count = 0;
    for (const row of rows) {
      const [query, label] = row.cells;
      const shown =
        (run === "" || label.textContent === run) && query.textContent.toLowerCase().includes(part);
      row.hidden = !shown;
      count += shown;
    }
    byId("count").textContent = `${count} of ${rows.length}`;
  }
  byId("only").addEventListener("change", filter);
  byId("name").addEventListener("input", filter);
  filter();

  // the map in 3D
  const scenes = JSON.parse(byId("scenes").textContent);
  const canvas = byId("view");
  const context = canvas.getContext("2d");
  const decode = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const add = (a, b, s) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [
    a[1] * b[2] - a[2] * b[1],
    a[2] * b[0] - a[0] * b[2],
    a[0] * b[1] - a[1] * b[0],
  ];
  const unit = (a) => add([0, 0, 0], a, 1 / (Math.hypot(...a) || 1));
  const view = { azimuth: 0.6, elevation: 0.5, distance: 1, target: [0, 0, 0] };
  let scene, points, colours, chosen = null, pending = false;

  function load(label) {
    scene = scenes[label];
    points = new Float32Array(decode(scene.points).buffer);
    colours = decode(scene.colours);
    reset();
  }

  function reset() {
    if (!scene) return;
    // from behind the cameras, a little above
    const [east, north] = ground();
    const poses = scene.queries.map((query) => query.pose).filter(Boolean).concat(scene.map);
    const back = poses.reduce((sum, pose) => add(sum, pose.slice(9, 12), -1), [0, 0, 0]);
    const azimuth = Math.atan2(dot(back, north), dot(back, east)) + 0.35;
    Object.assign(view, { azimuth, elevation: 0.4, distance: 1.5 * scene.radius, target: [0, 0, 0] });
    redraw();
  }

  // two horizontal axes
  function ground() {
    const east = unit(cross(scene.up, Math.abs(scene.up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
    return [east, cross(scene.up, east)];
  }

  // right, up and forward axes of the viewer in the world
  function axes() {
    const up = scene.up;
    const [east, north] = ground();
    const flat = add(add([0, 0, 0], east, Math.cos(view.azimuth)), north, Math.sin(view.azimuth));
    const back = add(add([0, 0, 0], flat, Math.cos(view.elevation)), up, Math.sin(view.elevation));
    const forward = add([0, 0, 0], back, -1);
    const right = unit(cross(forward, up));
    return { right, up: cross(right, forward), forward };
  }

  function redraw() {
    if (scene && !pending) {
      pending = true;
      requestAnimationFrame(draw);
    }
  }

  function draw() {
    pending = false;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
    canvas.width = width;
    canvas.height = height;
    const eye = axes();
    const position = add(view.target, eye.forward, -view.distance);
    const focal = 0.9 * Math.min(width, height);
    const project = (x, y, z) => {
      const offset = [x - position[0], y - position[1], z - position[2]];
      const depth = dot(offset, eye.forward);
      if (depth < 0.02 * view.distance) return null;
      const scale = focal / depth;
      return [width / 2 + scale * dot(offset, eye.right), height / 2 - scale * dot(offset, eye.up)];
    };
    context.clearRect(0, 0, width, height);
    const size = 2 * ratio;
    for (let i = 0; i < points.length; i += 3) {
      const place = project(points[i], points[i + 1], points[i + 2]);
      if (place === null) continue;
      context.fillStyle = `rgb(${colours[i]},${colours[i + 1]},${colours[i + 2]})`;
      context.fillRect(place[0], place[1], size, size);
    }
    const line = (a, b) => {
      const [from, to] = [project(...a), project(...b)];
      if (from === null || to === null) return;
      context.moveTo(...from);
      context.lineTo(...to);
    };
    const camera = (pose, colour, bold) => {
      const length = 0.035 * scene.radius * (bold ? 1.6 : 1);
      const centre = pose.slice(0, 3);
      const [right, down, forward] = [3, 6, 9].map((i) => pose.slice(i, i + 3));
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
        add(add(add(centre, forward, length), right, 0.7 * length * x), down, 0.5 * length * y));
      context.strokeStyle = colour;
      context.lineWidth = (bold ? 2 : 1) * ratio;
      context.beginPath();
      corners.forEach((corner, i) => {
        line(centre, corner);
        line(corner, corners[(i + 1) % 4]);
      });
      context.stroke();
    };
    scene.map.forEach((pose) => camera(pose, "#8a94a0", false));
    for (const query of scene.queries) {
      if (query.truth) camera(query.truth, "#1667d9", false);
      if (!query.pose) continue;
      const colour = query.status === "localized" ? "#1b9e4b" : "#d6322a";
      if (query.truth) {
        context.strokeStyle = colour;
        context.beginPath();
        line(query.pose.slice(0, 3), query.truth.slice(0, 3));
        context.stroke();
      }
      camera(query.pose, query.name === chosen ? "#e69f00" : colour, query.name === chosen);
    }
    canvas.dataset.azimuth = view.azimuth.toFixed(4);
  }

  const pointers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (before === undefined || !scene) return;
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    if (pointers.size === 2) {
      const [other] = [...pointers.values()].filter((p) => p.pointerId !== event.pointerId);
      const apart = (p) => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY) || 1;
      zoom(apart(before) / apart(event));
    } else if (event.buttons === 2 || event.shiftKey) {
      const eye = axes();
      const step = view.distance / canvas.clientHeight;
      view.target = add(add(view.target, eye.right, -x * step), eye.up, y * step);
    } else {
      view.azimuth -= 0.008 * x;
      view.elevation = Math.max(-1.5, Math.min(1.5, view.elevation + 0.008 * y));
    }
    pointers.set(event.pointerId, event);
    redraw();
  });
  function zoom(factor) {
    if (!scene) return;
    view.distance = Math.max(0.01, Math.min(50, (view.distance * factor) / scene.radius)) * scene.radius;
    redraw();
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(0.001 * event.deltaY));
  }, { passive: false });

  body.addEventListener("click", (event) => {
    const row = event.target.closest("tr");
    const query = row.cells[0].textContent;
    chosen = chosen === query ? null : query;
    rows.forEach((other) => other.classList.toggle("chosen", other.cells[0].textContent === chosen));
    redraw();
  });
  byId("scene").addEventListener("change", (event) => load(event.target.value));
  byId("reset").addEventListener("click", reset);
  window.addEventListener("resize", redraw);
  if (byId("scene").value) load(byId("scene").value);
})();
