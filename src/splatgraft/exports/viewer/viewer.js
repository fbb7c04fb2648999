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

  // the still stands on the screen before the engine takes the processor; a page in the background has no frames
  await new Promise((done) => {
    get("still").firstElementChild.decode().finally(() => requestAnimationFrame(() => setTimeout(done))).catch(() => {});
    setTimeout(done, 500);
  });
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

  // Scenes have many faint Gaussians in a row. Blended in the 8 bits of a canvas, each is rounded by channel, which tints
  // what they make up together; they are blended in 16-bit floats and copied.
  let target = null;
  if (device.textureHalfFloatRenderable) {
    const colors = new pc.Texture(device, { width: 4, height: 4, format: pc.PIXELFORMAT_RGBA16F, mipmaps: false });
    target = new pc.RenderTarget({ colorBuffer: colors, depth: false });
    app.on("postrender", () => {
      device.setScissor(0, 0, device.width, device.height); // a copy is clipped as well
      device.copyRenderTarget(target, null, true, false);
    });
  }

  // each scene has a layer and a camera, which draws the scene's side of the divider
  const cameras = view.scenes.map((label, index) => {
    const layer = new pc.Layer({ name: label });
    app.scene.layers.push(layer);
    const entity = new pc.Entity("camera");
    entity.addComponent("camera", {
      clearColor: new pc.Color(view.background[0], view.background[1], view.background[2]),
      nearClip: view.near, farClip: view.far, layers: [layer.id], priority: index, renderTarget: target,
    });
    entity.camera.camera._scissorRectClear = true; // else the engine takes the whole rectangle of the camera
    app.root.addChild(entity);
    return { entity, layer, sorted: 0 };
  });

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
    for (const { entity } of cameras) {
      entity.setPosition(now.x + d * Math.cos(e) * Math.sin(a), now.y + d * Math.sin(e), now.z + d * Math.cos(e) * Math.cos(a));
      entity.lookAt(center);
    }
  };
  const limit = () => {
    goal.elevation = Math.min(89, Math.max(-89, goal.elevation));
    goal.distance = Math.min(view.far / 2, Math.max(view.near * 3, goal.distance));
    wake();
  };
  const rotate = (dx, dy) => { goal.azimuth -= dx * 0.3; goal.elevation += dy * 0.3; limit(); };
  const zoom = (factor) => { goal.distance *= factor; limit(); };
  const pan = (dx, dy) => {
    const camera = cameras[0].entity;
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
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const does = {
      ArrowLeft: () => rotate(-20, 0), ArrowRight: () => rotate(20, 0), ArrowUp: () => rotate(0, 20),
      ArrowDown: () => rotate(0, -20), "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
      Home: reset, b: () => buttons.length && show(split === 0 ? 0 : 1),
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
  document.addEventListener("fullscreenchange", () =>
    whole.setAttribute("aria-pressed", String(document.fullscreenElement !== null)));

  // --- two scenes: the first is left of the divider, at this share of the width
  let split = view.split;
  const divider = get("divider");
  const divide = (share) => {
    split = Math.min(1, Math.max(0, share));
    divider.style.left = 100 * split + "%";
    divider.setAttribute("aria-valuenow", String(Math.round(100 * split)));
    buttons.forEach((button, index) => button.setAttribute("aria-pressed", String(split === 1 - index)));
    // half a pixel more, as the engine rounds down
    const at = (Math.round(split * device.width) + 0.5) / device.width;
    if (cameras.length > 1) {
      cameras[0].entity.camera.scissorRect = new pc.Vec4(0, 0, at, 1);
      cameras[1].entity.camera.scissorRect = new pc.Vec4(at, 0, 1, 1);
    }
    wake(2);
  };
  const show = (index) => divide(1 - index);
  divider.addEventListener("pointerdown", (event) => divider.setPointerCapture(event.pointerId));
  divider.addEventListener("pointermove", (event) => {
    if (divider.hasPointerCapture(event.pointerId)) divide(event.clientX / canvas.clientWidth);
  });
  divider.addEventListener("keydown", (event) => {
    const share = { ArrowLeft: split - 0.05, ArrowRight: split + 0.05, Home: 0, End: 1 }[event.key];
    if (share !== undefined) { event.preventDefault(); divide(share); }
  });

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
    if (target) target.resize(device.width, device.height);
    // `fov_deg` is the vertical one of a picture `view.aspect` wide; a narrower page shows the same width
    const tangent = Math.tan(view.fov_deg * Math.PI / 360);
    const narrower = Math.max(1, view.aspect * canvas.clientHeight / canvas.clientWidth);
    const fov = 2 * Math.atan(tangent * Math.min(narrower, view.widest)) * 180 / Math.PI;
    for (const { entity } of cameras) entity.camera.fov = fov;
    divide(split);
    wake();
  };
  new ResizeObserver(resize).observe(canvas);
  app.start();
  resize();
  place();
  // for a few frames after each move the order of the Gaussians is still the one before
  app.on("update", (dt) => {
    const slow = dt >= 0.1; // as without a GPU: no frames between here and there
    const step = slow ? 1 : 1 - Math.exp(-dt * 14);
    let moving = false;
    for (const key of keys) {
      const way = goal[key] - now[key];
      const small = key === "azimuth" || key === "elevation" ? 0.01 : 1e-4 * start.distance;
      if (Math.abs(way) > small) { now[key] += way * step; moving = true; } else now[key] = goal[key];
    }
    place();
    if (moving) frames = Math.max(frames, 20);
    if (frames > 0) { frames -= slow ? 4 : 1; app.renderNextFrame = true; } else document.body.dataset.still = "true";
  });
  let loaded = false;
  app.systems.gsplat.on("frame:ready", (camera, _layer, ready, loading) => {
    if (!ready || loading) return wake(2);
    const drawing = cameras.find(({ entity }) => entity.camera === camera);
    if (!loaded || !drawing) return;
    drawing.sorted += 1;
    if (document.body.dataset.state !== "loading" || cameras.some(({ sorted }) => sorted < 2)) return;
    get("still").remove();
    document.body.dataset.state = "ready";
    canvas.setAttribute("aria-busy", "false");
  });

  try {
    for (const [index, label] of view.scenes.entries()) {
      say(`Loading ${index + 1} of ${view.scenes.length} \u2026`);
      const entity = new pc.Entity(label);
      entity.addComponent("gsplat", { asset: await load("scene" + index), layers: [cameras[index].layer.id] });
      root.addChild(entity);
    }
  } catch (error) {
    return fail(`The scene could not be shown: ${error}`);
  }
  if (view.scenes.length > 1) {
    for (const [index, label] of view.scenes.entries()) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = label;
      button.addEventListener("click", () => show(index));
      buttons.push(button);
      get("scenes").append(button);
    }
  }
  loaded = true;
  say("");
  divide(split);
  wake(30);
})();
