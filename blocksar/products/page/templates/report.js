"use strict";
// The viewer has one state: the centre of the view (m, in SVG coordinates) and its scale (m per CSS pixel).
(() => {
  const $ = (id) => document.getElementById(id);
  const svg = $("scene"), viewer = $("viewer"), frame = $("frame");
  const numbers = (data) => Object.fromEntries(Object.entries(data).map(([name, value]) => [name, Number(value)]));
  const picture = numbers(svg.dataset);
  const places = [...svg.querySelectorAll(".place")];
  const labels = [...svg.querySelectorAll(".label")];
  const marks = [...svg.querySelectorAll(".mark")];
  // Margin around the whole picture; factor of a zoom step; size in CSS pixels of the finest pixel at the closest zoom;
  // size in CSS pixels of a cell from which chips are shown.
  const MARGIN = 1.02, STEP = 1.5, CLOSEST_PIXELS = 30, CHIP_PIXELS = 6;
  const view = { x: 0, y: 0, scale: 1 };
  // What is shown: the grey levels of a channel, or the colours of a composite, with the filter that sets their scale.
  const layer = (image, filter, range) => ({
    filter, levels: null, colours: image.id === "composite", range,
    ...Object.fromEntries(["x", "y", "width", "height"].map((name) => [name, Number(image.getAttribute(name))])),
  });
  const grey = layer($("pixels"), $("stretch"), picture);
  const colours = $("composite") && layer($("composite"), $("colours"), numbers($("composite").dataset));
  let shown = grey;
  let pressed = new Map(), returnTo = null, pointer = null, hintTimer = 0, showsAll = true;

  document.documentElement.classList.add("scripted");

  // ---------------------------------------------------------------- numbers

  function number(value, digits) {
    const text = Math.abs(value).toFixed(digits).replace(/\B(?=(\d{3})+(?!\d))/g, "\u202f");
    return (value < 0 && Number(value.toFixed(digits)) !== 0 ? "\u2212" : "") + text;
  }

  function decimals(step) {
    return Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  }

  // The smallest of 1, 2 and 5 times a power of ten that is not below a value.
  function roundUp(value) {
    const decade = 10 ** Math.floor(Math.log10(value));
    return [1, 2, 5, 10].find((step) => step * decade >= value * (1 - 1e-9)) * decade;
  }

  const display = (id, on) => (on ? $(id).removeAttribute("display") : $(id).setAttribute("display", "none"));

  // ---------------------------------------------------------------- view

  const size = () => ({ width: viewer.clientWidth || 1, height: viewer.clientHeight || 1 });
  const widest = () => MARGIN * Math.max(picture.width / size().width, picture.height / size().height);
  const chips = $("chips") !== null; // chips have smaller pixels than the picture's cells
  const closest = () => Math.min(picture.pixel / CLOSEST_PIXELS, widest() / 4);
  // Limit the centre of the view so that the view stays within the picture.
  const within = (value, extent, visible) => {
    const free = Math.max(0, (extent - visible) / 2);
    return Math.min(free, Math.max(-free, value));
  };

  function show(x, y, scale) {
    const { width, height } = size();
    view.scale = Math.min(widest(), Math.max(closest(), scale));
    showsAll = view.scale >= widest() * (1 - 1e-9);
    view.x = within(x, picture.width, width * view.scale);
    view.y = within(y, picture.height, height * view.scale);
    const [w, h] = [width * view.scale, height * view.scale];
    svg.setAttribute("viewBox", `${view.x - w / 2} ${view.y - h / 2} ${w} ${h}`);
    for (const place of places) {
      place.setAttribute("transform", `translate(${place.dataset.x} ${place.dataset.y}) scale(${view.scale})`);
    }
    viewer.classList.toggle("zoomed", !showsAll);
    if (chips) display("chips", shown === grey && view.scale < picture.cell / CHIP_PIXELS);
    $("zoom-out").disabled = $("reset").disabled = showsAll;
    $("zoom-in").disabled = view.scale <= closest() * (1 + 1e-9);
    placeNames();
    drawFrame();
    updateReadout();
  }

  const showAll = () => show(0, 0, widest());
  const move = (right, down) => show(view.x + right * view.scale, view.y + down * view.scale, view.scale);

  // Zoom with a fixed point (px, py), in CSS pixels from the viewer's centre.
  function zoom(factor, px = 0, py = 0) {
    const scale = Math.min(widest(), Math.max(closest(), view.scale / factor));
    show(view.x + px * (view.scale - scale), view.y + py * (view.scale - scale), scale);
  }

  function fromCentre(event) {
    const box = viewer.getBoundingClientRect();
    return [event.clientX - box.left - box.width / 2, event.clientY - box.top - box.height / 2];
  }

  function announce() {
    const zoomed = widest() / view.scale;
    $("announcement").textContent =
      `Zoom ${number(zoomed, 1)}, centre at x ${number(picture.x + view.x, 0)} m, y ${number(picture.y - view.y, 0)} m`;
  }

  // ---------------------------------------------------------------- names, axes, scale bar

  // Place names in order of rank: the chosen target, then those whose responses are drawn; leave out those that overlap.
  function placeNames() {
    const occupied = labels.map(({ dataset, textContent }) => {
      const x = (dataset.x - view.x) / view.scale, y = (dataset.y - view.y) / view.scale;
      return [x - 4 * textContent.length, y - 14, x + 4 * textContent.length, y + 4];
    });
    const rank = (mark) => (mark.classList.contains("chosen") ? 0 : mark.classList.contains("first") ? 1 : 2);
    const namesOn = $("toggle-names")?.getAttribute("aria-pressed") === "true";
    for (const mark of [...marks].sort((a, b) => rank(a) - rank(b))) {
      const x = (mark.dataset.x - view.x) / view.scale + 9, y = (mark.dataset.y - view.y) / view.scale - 6;
      const box = [x, y - 14, x + 8 * mark.dataset.name.length + 4, y + 4];
      const free = occupied.every((t) => box[2] < t[0] || t[2] < box[0] || box[3] < t[1] || t[3] < box[1]);
      mark.classList.toggle("named", namesOn && free);
      if (free) occupied.push(box);
    }
  }

  function draw(parent, kind, attributes, text = "") {
    const element = document.createElementNS("http://www.w3.org/2000/svg", kind);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.textContent = text;
    parent.append(element);
  }

  function drawFrame() {
    const { width, height } = size();
    frame.replaceChildren();
    const step = roundUp(view.scale * 110);
    const [unit, per] = step >= 1000 ? ["km", 1000] : ["m", 1];
    const label = (value) => number(value / per, decimals(step / per));
    const first = (edge) => Math.ceil(edge / step) * step;
    const left = picture.x + view.x - (width / 2) * view.scale, low = picture.y - view.y - (height / 2) * view.scale;
    for (let x = first(left); x < left + width * view.scale; x += step) {
      const at = (x - left) / view.scale;
      if (at < 90 || at > width - 30) continue;
      draw(frame, "path", { d: `M${at} ${height}v-8`, class: "halo" });
      draw(frame, "path", { d: `M${at} ${height}v-8` });
      draw(frame, "text", { x: at, y: height - 12, "text-anchor": "middle" }, label(x));
    }
    for (let y = first(low); y < low + height * view.scale; y += step) {
      const at = height - (y - low) / view.scale;
      if (at < 30 || at > height - 60) continue;
      draw(frame, "path", { d: `M0 ${at}h6`, class: "halo" });
      draw(frame, "path", { d: `M0 ${at}h6` });
      draw(frame, "text", { x: 16, y: at + 4 }, label(y));
    }
    draw(frame, "text", { x: 12, y: height - 12 }, `x, y (${unit})`);
    const bar = roundUp(view.scale * 45), long = bar / view.scale;
    draw(frame, "rect", { x: 12, y: 28, width: long, height: 5 });
    draw(frame, "text", { x: 12, y: 20 }, bar >= 1000 ? `${bar / 1000} km` : `${bar} m`);
  }

  // ---------------------------------------------------------------- readout

  function readLevels(layer, image) {
    const pixels = new Image();
    pixels.addEventListener("load", () => {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [pixels.naturalWidth, pixels.naturalHeight];
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(pixels, 0, 0);
      layer.levels = context.getImageData(0, 0, canvas.width, canvas.height);
      updateReadout();
    });
    pixels.src = image.getAttribute("href");
  }
  readLevels(grey, $("pixels"));
  if (colours) readLevels(colours, $("composite"));

  function decibel(x, y) {
    const { levels, range } = shown;
    if (!levels) return "";
    const column = Math.floor(((x - shown.x) / shown.width) * levels.width);
    const row = Math.floor(((y - shown.y) / shown.height) * levels.height);
    if (column < 0 || row < 0 || column >= levels.width || row >= levels.height) return "outside the image";
    const at = 4 * (row * levels.width + column);
    if (levels.data[at + 3] === 0) return "not covered";
    const value = (level) =>
      `${level === 0 ? "at most " : ""}${number(range.bottom + (level / 255) * (range.top - range.bottom), 1)} dB`;
    const names = ["red", "green", "blue"];
    return shown.colours ? names.map((name, k) => `${name} ${value(levels.data[at + k])}`).join(", ") : value(levels.data[at]);
  }

  function updateReadout() {
    const [px, py] = pointer ?? [0, 0];
    const x = view.x + px * view.scale, y = view.y + py * view.scale;
    const digits = Math.min(3, decimals(view.scale));
    const where = `x ${number(picture.x + x, digits)} m, y ${number(picture.y - y, digits)} m`;
    $("readout").textContent = `${pointer ? "Pointer" : "Centre"}: ${where}; ${decibel(x, y)}`;
  }

  // ---------------------------------------------------------------- mouse, touch, wheel

  viewer.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    viewer.setPointerCapture(event.pointerId);
    pressed.set(event.pointerId, fromCentre(event));
    viewer.classList.add("dragging");
  });
  viewer.addEventListener("pointermove", (event) => {
    const now = fromCentre(event);
    pointer = now;
    const before = pressed.get(event.pointerId);
    if (!before) return updateReadout();
    const other = [...pressed].find(([id]) => id !== event.pointerId)?.[1];
    pressed.set(event.pointerId, now);
    if (other) {
      const distance = (p) => Math.max(Math.hypot(p[0] - other[0], p[1] - other[1]), 1);
      move((before[0] - now[0]) / 2, (before[1] - now[1]) / 2);
      zoom(distance(now) / distance(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    } else {
      move(before[0] - now[0], before[1] - now[1]);
    }
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    viewer.addEventListener(kind, (event) => {
      pressed.delete(event.pointerId);
      viewer.classList.toggle("dragging", pressed.size > 0);
    });
  }
  viewer.addEventListener("pointerleave", () => { pointer = null; updateReadout(); });
  viewer.addEventListener("dblclick", (event) => zoom(2, ...fromCentre(event)));
  viewer.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey && document.activeElement !== viewer) {
      $("hint").classList.add("shown");
      clearTimeout(hintTimer);
      hintTimer = setTimeout(() => $("hint").classList.remove("shown"), 1500);
      return;
    }
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
    zoom(Math.min(2, Math.max(0.5, 1.003 ** (-event.deltaY * lines))), ...fromCentre(event));
  }, { passive: false });

  // ---------------------------------------------------------------- keys and buttons

  const share = (part) => [part * size().width, part * size().height];
  const actions = {
    "zoom-in": () => zoom(STEP),
    "zoom-out": () => zoom(1 / STEP),
    reset: showAll,
    left: () => move(-share(0.25)[0], 0),
    right: () => move(share(0.25)[0], 0),
    up: () => move(0, -share(0.25)[1]),
    down: () => move(0, share(0.25)[1]),
  };
  const keys = {
    "+": "zoom-in", "=": "zoom-in", "-": "zoom-out", _: "zoom-out", 0: "reset", Home: "reset",
    ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down",
  };

  function act(action) {
    actions[action]();
    announce();
  }

  for (const action of Object.keys(actions)) $(action).addEventListener("click", () => act(action));
  viewer.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Escape" && returnTo) {
      returnTo.focus();
      returnTo = null;
    } else if (keys[event.key]) {
      event.preventDefault();
      act(keys[event.key]);
    }
  });

  function toggle(id, apply) {
    const button = $(id);
    button?.addEventListener("click", () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", String(on));
      apply(on);
    });
  }
  toggle("toggle-borders", (on) => display("borders", on));
  toggle("toggle-marks", (on) => display("marks", on));
  toggle("toggle-names", placeNames);

  // ---------------------------------------------------------------- grey scale

  const black = $("black"), white = $("white");

  function stretch(dark, bright) {
    const { top, bottom } = shown.range;
    const slope = (top - bottom) / (bright - dark), intercept = (bottom - dark) / (bright - dark);
    for (const channel of shown.filter.querySelectorAll("feFuncR, feFuncG, feFuncB")) {
      channel.setAttribute("slope", slope);
      channel.setAttribute("intercept", intercept);
    }
    for (const [input, value] of [[black, dark], [white, bright]]) {
      input.value = value;
      $(`${input.id}-value`).textContent = `${number(value, 0)} dB`;
      input.setAttribute("aria-valuetext", `${number(value, 0)} decibels`);
    }
  }
  black.addEventListener("input", () => stretch(Math.min(Number(black.value), Number(white.value) - 1), Number(white.value)));
  white.addEventListener("input", () => stretch(Number(black.value), Math.max(Number(white.value), Number(black.value) + 1)));
  $("grey-reset").addEventListener("click", () => stretch(shown.range.black, shown.range.white));

  // ---------------------------------------------------------------- composite

  toggle("toggle-composite", (on) => {
    shown = on ? colours : grey;
    display("composite", on);
    display("pixels", !on);
    for (const input of [black, white]) {
      input.min = Math.round(shown.range.bottom - 1);
      input.max = Math.round(shown.range.top + 1);
    }
    stretch(shown.range.black, shown.range.white);
    show(view.x, view.y, view.scale);
  });

  // ---------------------------------------------------------------- tables

  for (const link of document.querySelectorAll("a.goto")) {
    link.addEventListener("click", (event) => {
      event.preventDefault();
      const { x, y, name } = link.dataset;
      for (const mark of marks) {
        mark.classList.toggle("chosen", mark.dataset.x === x && mark.dataset.y === y);
      }
      show(Number(x), Number(y), Math.min(view.scale, chips ? 4 * closest() : Math.max(widest() / 8, 2 * closest())));
      returnTo = link;
      viewer.focus({ preventScroll: true });
      viewer.scrollIntoView({ block: "nearest" });
      $("announcement").textContent = `Target ${name} is centred in the image. Escape returns to the table.`;
    });
  }

  function sort(table, column, head) {
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const value = (row) => row.cells[column].dataset.sort;
    const order = (a, b) => {
      const [p, q] = [value(a), value(b)];
      if (p === "" || q === "") return (p === "") - (q === ""); // unknown values come last
      const difference = Number(p) - Number(q);
      const result = Number.isNaN(difference) ? p.localeCompare(q, "en", { numeric: true }) : difference;
      return down ? -result : result;
    };
    table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
    table.parentElement.scrollTop = 0;
  }

  for (const table of document.querySelectorAll("table.sortable")) {
    [...table.tHead.rows[0].cells].forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => sort(table, column, head));
    });
  }

  // ---------------------------------------------------------------- start

  stretch(shown.range.black, shown.range.white);
  showAll();
  new ResizeObserver(() => (showsAll ? showAll() : show(view.x, view.y, view.scale))).observe(viewer);
})();
