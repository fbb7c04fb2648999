"use strict";
// Shows the scenes that the page holds; everything is in the page, nothing is fetched.
(async () => {
  const get = (id) => document.getElementById(id);
  const say = (text) => { get("message").textContent = text; };
  const view = JSON.parse(get("view").textContent);
  const bytes = (id) => {
    const element = get(id);
    const text = atob(element.textContent.trim());
    element.remove(); // the text is no longer needed, and is large
    const out = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
    return out;
  };
  const fail = (text) => { say(text); document.body.dataset.state = "failed"; };

  if (!window.DecompressionStream) return fail("This browser is too old to show the scene.");
  const unpacked = new Blob([bytes("engine")]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(unpacked).text();
  document.head.append(script);

  const canvas = get("canvas");
  let device;
  try {
    device = new pc.WebglGraphicsDevice(canvas, { antialias: false, alpha: false, powerPreference: "high-performance" });
  } catch (error) {
    return fail("This browser cannot draw the scene: it has no WebGL 2.");
  }
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.TextureHandler, pc.GSplatHandler, pc.ContainerHandler];
  const app = new pc.AppBase(canvas);
  app.init(options);
  app.autoRender = false;
  const splats = app.scene.gsplat;
  splats.dataFormat = "large"; // colours in 16 bits
  splats.minPixelSize = 0;     // small and faint Gaussians are drawn as well
  splats.minContribution = 0;
  splats.colorUpdateAngle = 0.5;

  // the page's world has y up; `root` turns the scene's own up direction there
  const vector = (values) => new pc.Vec3(values[0], values[1], values[2]);
  const turn = new pc.Quat().setFromDirections(vector(view.up), pc.Vec3.UP);
  const root = new pc.Entity("scene");
  root.setLocalRotation(turn);
  app.root.addChild(root);
  const camera = new pc.Entity("camera");
  camera.addComponent("camera", {
    clearColor: new pc.Color(view.background[0], view.background[1], view.background[2]),
    fov: view.fov_deg, nearClip: view.near, farClip: view.far,
  });
  app.root.addChild(camera);

  // --- the orbit: angles in degrees, goal and where the camera is on its way there
  const start = (() => {
    const center = turn.transformVector(vector(view.center));
    const offset = turn.transformVector(vector(view.eye)).sub(center);
    const distance = offset.length();
    return { azimuth: Math.atan2(offset.x, offset.z) * 180 / Math.PI, distance,
      elevation: Math.asin(offset.y / distance) * 180 / Math.PI, x: center.x, y: center.y, z: center.z };
  })();
  const keys = Object.keys(start);
  const goal = { ...start }, now = { ...start };
  let frames = 0; // left to draw: sorting follows the camera by a few
  const wake = (count = 20) => {
    frames = Math.max(frames, count);
    app.renderNextFrame = true;
    document.body.dataset.still = "false";
  };
  const place = () => {
    const a = now.azimuth * Math.PI / 180, e = now.elevation * Math.PI / 180, d = now.distance;
    const center = new pc.Vec3(now.x, now.y, now.z);
    camera.setPosition(now.x + d * Math.cos(e) * Math.sin(a), now.y + d * Math.sin(e), now.z + d * Math.cos(e) * Math.cos(a));
    camera.lookAt(center);
  };
  const limit = () => {
    goal.elevation = Math.min(89, Math.max(-89, goal.elevation));
    goal.distance = Math.min(view.far / 2, Math.max(view.near * 3, goal.distance));
    wake();
  };
  const rotate = (dx, dy) => { goal.azimuth -= dx * 0.3; goal.elevation += dy * 0.3; limit(); };
  const zoom = (factor) => { goal.distance *= factor; limit(); };
  const pan = (dx, dy) => {
    const unit = 2 * now.distance * Math.tan(camera.camera.fov * Math.PI / 360) / canvas.clientHeight;
    const move = camera.right.clone().mulScalar(-dx * unit).add(camera.up.clone().mulScalar(dy * unit));
    goal.x += move.x; goal.y += move.y; goal.z += move.z;
    limit();
  };
  const reset = () => {
    Object.assign(goal, start);
    goal.azimuth += 360 * Math.round((now.azimuth - start.azimuth) / 360); // the short way back
    wake();
  };

  // --- mouse, fingers, keys
  const pointers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, pans: event.button === 2 || event.shiftKey });
  });
  const middle = () => {
    const [a, b] = [...pointers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  canvas.addEventListener("pointermove", (event) => {
    const pointer = pointers.get(event.pointerId);
    if (!pointer) return;
    const dx = event.clientX - pointer.x, dy = event.clientY - pointer.y;
    const before = pointers.size === 2 ? middle() : null;
    pointer.x = event.clientX; pointer.y = event.clientY;
    if (before) {
      const after = middle();
      if (after.apart > 0 && before.apart > 0) zoom(before.apart / after.apart);
      pan(after.x - before.x, after.y - before.y);
    } else if (pointers.size === 1) (pointer.pans ? pan : rotate)(dx, dy);
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.003));
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", reset);
  const buttons = [];
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const does = {
      ArrowLeft: () => rotate(-20, 0), ArrowRight: () => rotate(20, 0), ArrowUp: () => rotate(0, 20),
      ArrowDown: () => rotate(0, -20), "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
      Home: reset, b: () => entities.length === view.scenes.length && show((shown + 1) % entities.length),
    }[event.key];
    if (does) { event.preventDefault(); does(); }
  });
  get("reset").addEventListener("click", reset);
  const whole = get("whole");
  if (!document.documentElement.requestFullscreen) whole.remove();
  whole.addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen();
  });

  // --- the scenes
  const entities = [];
  let shown = 0;
  const show = (index) => {
    shown = index;
    entities.forEach((entity, i) => { entity.enabled = i === index; });
    buttons.forEach((button, i) => button.setAttribute("aria-pressed", String(i === index)));
    document.body.dataset.shown = view.scenes[index];
    wake(30);
  };
  const load = (id) => new Promise((resolve, reject) => {
    const contents = bytes(id).buffer;
    const asset = new pc.Asset(id, "gsplat", { url: id + ".sog", filename: id + ".sog", contents });
    asset.once("load", () => resolve(asset));
    asset.once("error", reject);
    app.assets.add(asset);
    app.assets.load(asset);
  });

  const resize = () => {
    // more pixels than twice the page's are not seen, and cost time
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    device.resizeCanvas(Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio));
    // `fov_deg` is the vertical one of a picture `view.aspect` wide; a narrower page shows the same width
    const tangent = Math.tan(view.fov_deg * Math.PI / 360);
    const narrower = Math.max(1, view.aspect * canvas.clientHeight / canvas.clientWidth);
    camera.camera.fov = 2 * Math.atan(tangent * Math.min(narrower, 2)) * 180 / Math.PI;
    wake();
  };
  new ResizeObserver(resize).observe(canvas);
  app.start();
  resize();
  place();
  // for a few frames after each move the order of the Gaussians is still the one before
  app.on("update", (dt) => {
    const step = 1 - Math.exp(-Math.min(dt, 0.1) * 14);
    let moving = false;
    for (const key of keys) {
      const way = goal[key] - now[key];
      const small = key === "azimuth" || key === "elevation" ? 0.01 : 1e-4 * start.distance;
      if (Math.abs(way) > small) { now[key] += way * step; moving = true; } else now[key] = goal[key];
    }
    place();
    if (moving) frames = Math.max(frames, 20);
    if (frames > 0) { frames -= 1; app.renderNextFrame = true; } else document.body.dataset.still = "true";
  });
  let sorted = 0;
  app.systems.gsplat.on("frame:ready", (_camera, _layer, ready, loading) => {
    if (!ready || loading) return wake(2);
    if (entities.length === view.scenes.length && ++sorted === 2) {
      document.body.dataset.state = "ready";
      canvas.setAttribute("aria-busy", "false");
    }
  });

  try {
    for (const [index, label] of view.scenes.entries()) {
      say(`Loading ${index + 1} of ${view.scenes.length} \u2026`);
      const entity = new pc.Entity(label);
      entity.addComponent("gsplat", { asset: await load("scene" + index) });
      entities.push(entity);
      root.addChild(entity);
      entity.enabled = index === view.first;
      if (view.scenes.length > 1) {
        const button = document.createElement("button");
        button.type = "button";
        button.textContent = label;
        button.addEventListener("click", () => show(index));
        buttons.push(button);
        get("scenes").append(button);
      }
      wake();
    }
  } catch (error) {
    return fail(`The scene could not be shown: ${error}`);
  }
  say("");
  show(view.first);
})();
