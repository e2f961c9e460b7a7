// The 3D view of one attempt: table, object, links of the hand, contacts. Needs three.js (r147).
"use strict";
(() => {
  const box = document.getElementById("view3d");
  const note = box.querySelector(".loading");
  const { scene: data, meshes, colours, kinds } = JSON.parse(document.getElementById("scene").textContent);
  const NORMAL = 0.03, PER_NEWTON = 0.001, DOT = kinds ? 0.004 : 0.003;
  const UP = new THREE.Vector3(0, 0, 1);

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  } catch (error) {
    note.textContent = "This browser has no WebGL: no 3D view.";
    return;
  }
  renderer.outputEncoding = THREE.sRGBEncoding;
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));

  // Colours are given as a screen shows them.
  THREE.ColorManagement.legacyMode = false;
  // Z is up, as on the table.
  THREE.Object3D.DefaultUp.set(0, 0, 1);
  const scene = new THREE.Scene();
  const sky = new THREE.HemisphereLight("#ffffff", "#9aa0a8", 0.9);
  scene.add(sky);
  const sun = new THREE.DirectionalLight("#ffffff", 0.75);
  sun.position.set(0.6, -0.8, 1.4);
  scene.add(sun);
  const table = new THREE.Mesh(
    new THREE.CircleGeometry(0.35, 64),
    new THREE.MeshStandardMaterial({ color: "#b9afa0", roughness: 1 }),
  );
  table.position.z = -0.001;
  scene.add(table);
  scene.add(new THREE.AxesHelper(0.05));

  const camera = new THREE.PerspectiveCamera(35, 1, 0.01, 20);
  const controls = new THREE.OrbitControls(camera, renderer.domElement);
  const object = new THREE.Group();
  const hand = new THREE.Group();
  const contacts = new THREE.Group();
  const forces = new THREE.Group();
  const palms = new THREE.Group();
  const around = new THREE.Group();
  const layers = { hand, object, contacts, forces, palms, around };
  for (const kind of Object.keys(kinds || {})) layers[kind] = new THREE.Group();
  // Arms are loaded when they are first shown.
  const arms = Object.keys(data.arms).map((name) => (layers[name] = new THREE.Group()));
  scene.add(...Object.values(layers));
  const place = (group, columns) => {
    group.matrixAutoUpdate = false;
    group.matrix.fromArray(columns);
  };
  place(object, data.object);
  // Around the object in a scene of several: its neighbours, and walls that never move.
  const others = (data.others || []).map(({ pose }) => {
    const other = new THREE.Group();
    place(other, pose);
    around.add(other);
    return other;
  });
  const look = { color: "#8d949d", roughness: 1, transparent: true, opacity: 0.35, depthWrite: false, flatShading: true };
  for (const { vertices, faces } of data.walls || []) {
    const surface = new THREE.BufferGeometry();
    surface.setAttribute("position", new THREE.Float32BufferAttribute(vertices, 3));
    surface.setIndex(faces);
    around.add(new THREE.Mesh(surface, new THREE.MeshStandardMaterial(look)));
  }
  const links = meshes.links.map(() => new THREE.Group());
  links.forEach((link) => hand.add(link));

  function draw() {
    renderer.render(scene, camera);
  }

  // The page says the colours of its theme.
  function paint() {
    const style = getComputedStyle(box);
    scene.background = new THREE.Color(style.getPropertyValue("--sky").trim());
    table.material.color.set(style.getPropertyValue("--table").trim());
    draw();
  }

  function resize() {
    const width = box.clientWidth, height = box.clientHeight;
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    draw();
  }

  // Contacts lie between finger and object: they are drawn over both.
  function mark(colour) {
    return new THREE.MeshBasicMaterial({ color: colour, depthTest: false, transparent: true });
  }

  function arrow(group, from, vector, colour, radius) {
    const length = vector.length();
    if (length < 1e-4) return;
    const material = mark(colour);
    const head = Math.min(0.4 * length, 5 * radius);
    const shaft = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, length - head, 12), material);
    const tip = new THREE.Mesh(new THREE.ConeGeometry(2.4 * radius, head, 16), material);
    shaft.position.y = (length - head) / 2;
    tip.position.y = length - head / 2;
    const whole = new THREE.Group();
    whole.add(shaft, tip);
    whole.position.copy(from);
    whole.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), vector.clone().normalize());
    whole.traverse((part) => { part.renderOrder = 2; });
    group.add(whole);
  }

  // As on the images: a ring that lies on the surface, a dot, a square.
  function shape(kind) {
    if (kind === "requested") return new THREE.TorusGeometry(1.6 * DOT, 0.3 * DOT, 12, 32);
    if (kind === "true") return new THREE.BoxGeometry(1.9 * DOT, 1.9 * DOT, 0.6 * DOT);
    return new THREE.SphereGeometry(DOT, 24, 16);
  }

  // Palms of more grasps: a plate, and a line along +Gz.
  for (const palm of data.palms || []) {
    const p = new THREE.Vector3(...palm.p), z = new THREE.Vector3(...palm.z);
    const plate = new THREE.Mesh(new THREE.BoxGeometry(0.008, 0.008, 0.002), new THREE.MeshBasicMaterial({ color: palm.colour }));
    const line = new THREE.Mesh(new THREE.CylinderGeometry(0.0007, 0.0007, 0.03, 8), plate.material);
    plate.position.copy(p);
    plate.quaternion.setFromUnitVectors(UP, z);
    line.position.copy(p).addScaledVector(z, 0.015);
    line.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), z);
    palms.add(plate, line);
  }

  function show(name) {
    const state = data.states[name];
    state.links.forEach((columns, i) => place(links[i], columns));
    links.forEach((link, i) => { link.visible = i < state.links.length; });
    for (const name of ["contacts", "forces", ...Object.keys(kinds || {})]) layers[name].clear();
    for (const contact of state.contacts) {
      const colour = kinds ? kinds[contact.kind] || "#555b63" : colours[contact.finger % colours.length];
      const group = kinds ? layers[contact.kind] : contacts;
      const p = new THREE.Vector3(...contact.p), n = new THREE.Vector3(...contact.n);
      if (group) {
        const dot = new THREE.Mesh(shape(contact.kind), mark(colour));
        dot.position.copy(p);
        dot.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), n.lengthSq() ? n.clone().normalize() : new THREE.Vector3(0, 0, 1));
        dot.renderOrder = 3;
        group.add(dot);
        arrow(group, p, n.multiplyScalar(NORMAL), colour, 0.0006);
      }
      // A force pushes into the object: its arrow ends at the contact.
      const f = new THREE.Vector3(...contact.f).multiplyScalar(PER_NEWTON);
      arrow(forces, p.clone().sub(f), f, colour, 0.0016);
    }
    for (const button of document.querySelectorAll("button[data-state]")) button.classList.toggle("on", button.dataset.state === name);
    box.dataset.state = name;
    draw();
  }

  // Numbers of four bytes, in base64.
  function numbers(text, Kind) {
    return new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  }

  async function load(url, group, colour) {
    const answer = await fetch(url);
    if (!answer.ok) throw new Error(`${url}: ${answer.status}`);
    for (const part of await answer.json()) {
      const surface = new THREE.BufferGeometry();
      surface.setAttribute("position", new THREE.BufferAttribute(numbers(part.vertices, Float32Array), 3));
      surface.setIndex(new THREE.BufferAttribute(numbers(part.faces, Uint32Array), 1));
      const look = { color: colour || part.colour, metalness: 0, roughness: 0.75, flatShading: true };
      if (group.parent === hand) Object.assign(look, { transparent: true, opacity: 0.8 });
      // The triangles of an arm have no outer side.
      if (part.opacity) Object.assign(look, { transparent: part.opacity < 1, opacity: part.opacity, side: THREE.DoubleSide });
      group.add(new THREE.Mesh(surface, new THREE.MeshStandardMaterial(look)));
    }
  }

  function aim() {
    const bounds = new THREE.Box3().setFromObject(object);
    for (const other of others) bounds.expandByObject(other);
    if (bounds.isEmpty()) bounds.set(new THREE.Vector3(-0.05, -0.05, 0), new THREE.Vector3(0.05, 0.05, 0.1));
    const all = new THREE.Box3().setFromObject(hand).union(bounds).union(new THREE.Box3().setFromObject(palms));
    for (const arm of arms) if (arm.visible) all.expandByObject(arm);
    const middle = bounds.getCenter(new THREE.Vector3()).lerp(all.getCenter(new THREE.Vector3()), 0.5);
    const radius = all.getSize(new THREE.Vector3()).length() / 2;
    // From beside the palm, so that the hand does not hide the object.
    const palm = links.length ? new THREE.Vector3().setFromMatrixPosition(links[0].matrix).sub(middle) : new THREE.Vector3(1, 0, 0);
    const azimuth = Math.atan2(palm.y, palm.x) + 1.1;
    const towards = new THREE.Vector3(Math.cos(azimuth), Math.sin(azimuth), 0.45).normalize();
    camera.position.copy(middle).addScaledVector(towards, 1.05 * radius / Math.sin((camera.fov * Math.PI) / 360));
    controls.target.copy(middle);
    controls.update();
  }

  const names = [...document.querySelectorAll("button[data-state]")].map((button) => button.dataset.state);
  const first = names.includes("closed") ? "closed" : names[0];
  const jobs = meshes.links.map((url, i) => load(url, links[i]));
  const instances = data.colours || [];
  if (data.hasObject) jobs.push(load(meshes.object, object, instances[0]));
  others.forEach((other, i) => jobs.push(load(data.others[i].mesh, other, instances[i + 1])));
  Promise.allSettled(jobs).then((results) => {
    const failed = results.find((result) => result.status === "rejected");
    if (failed) note.textContent = `A mesh cannot be shown: ${failed.reason.message}`;
    else note.remove();
    box.append(renderer.domElement);
    show(first);
    scene.updateMatrixWorld(true);
    aim();
    paint();
    resize();
    addEventListener("theme", paint);
    controls.addEventListener("change", draw);
    new ResizeObserver(resize).observe(box);
    box.dataset.ready = failed ? "partly" : "yes";
  });

  document.addEventListener("click", (event) => {
    const button = event.target.closest("button[data-state]");
    if (button) show(button.dataset.state);
  });
  const boxes = [...document.querySelectorAll("[data-layer]")];
  for (const check of boxes) {
    const name = check.dataset.layer, url = data.arms[name];
    check.addEventListener("change", () => {
      layers[name].visible = check.checked;
      draw();
    });
    if (!url) continue;
    check.addEventListener("change", () => {
      load(url, layers[name]).then(aim).then(draw).catch((error) => { check.parentElement.append(`: ${error.message}`); });
    }, { once: true });
  }

  // By keys: angles in radians about the vertical and above the table, a factor of the distance.
  const STEP = Math.PI / 18;
  function move(turn, rise, factor) {
    const offset = camera.position.clone().sub(controls.target);
    const height = Math.PI / 2 - offset.angleTo(UP);
    const risen = Math.min(Math.max(height + rise, -1.5), 1.5) - height;
    offset.applyAxisAngle(new THREE.Vector3().crossVectors(offset, UP).normalize(), risen);
    offset.applyAxisAngle(UP, turn).multiplyScalar(factor);
    camera.position.copy(controls.target).add(offset);
    controls.update();
    draw();
  }
  const turns = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };
  const zooms = { "+": 0.85, "=": 0.85, "-": 1 / 0.85 };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || !box.dataset.ready) return;
    if (document.querySelector("dialog[open]") || event.target.closest("input:not([type=checkbox]), select")) return;
    const check = boxes.find((each) => each.dataset.key === event.key.toLowerCase());
    const state = document.querySelectorAll("button[data-state]")[Number.parseInt(event.key, 10) - 1];
    if (event.shiftKey && event.key in turns) move(...turns[event.key], 1);
    else if (event.key in zooms) move(0, 0, zooms[event.key]);
    else if (event.key === "0") { aim(); draw(); }
    else if (state) show(state.dataset.state);
    else if (check) check.click();
    else return;
    event.preventDefault();
  });
})();
