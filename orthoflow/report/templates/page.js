"use strict";
(() => {
  const root = document.documentElement;

  // Colours: system setting, light, dark. The choice is stored if the browser permits it.
  const themes = { auto: "system setting", light: "light", dark: "dark" };
  const store = {
    read(key) { try { return localStorage.getItem(key); } catch { return null; } },
    write(key, value) { try { localStorage.setItem(key, value); } catch { /* private windows */ } },
  };
  const THEME = "orthoflow-theme";
  const button = document.getElementById("theme");
  const show = (name) => {
    if (name === "auto") root.removeAttribute("data-theme"); else root.dataset.theme = name;
    button.textContent = `colours: ${themes[name]}`;
    button.setAttribute("aria-label", button.textContent);
  };
  let theme = store.read(THEME) in themes ? store.read(THEME) : "auto";
  show(theme);
  button.addEventListener("click", () => {
    const names = Object.keys(themes);
    theme = names[(names.indexOf(theme) + 1) % names.length];
    store.write(THEME, theme);
    show(theme);
  });

  // Tables: a heading with data-sort becomes a button. Rows without a value are last in both orders.
  const placeOf = (row, index) => row.cells[index];
  const keyOf = (row, index, kind) => {
    const place = placeOf(row, index);
    if (kind === "text") return place.textContent.trim();
    const given = place.dataset.value ?? place.textContent;
    return given.trim() === "" ? NaN : Number(given);
  };
  const compare = (one, other, kind, direction) => {
    if (kind === "text") return direction * one.localeCompare(other, "en", { numeric: true });
    if (Number.isNaN(one) || Number.isNaN(other)) return Number.isNaN(one) - Number.isNaN(other);
    return direction * (one - other);
  };
  for (const heading of document.querySelectorAll("th[data-sort]")) {
    const label = heading.firstElementChild;
    const trigger = document.createElement("button");
    trigger.type = "button";
    trigger.append(...label.childNodes);
    label.replaceWith(trigger);
    trigger.addEventListener("click", () => {
      const direction = heading.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      for (const other of heading.parentElement.cells) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", direction === 1 ? "ascending" : "descending");
      const body = heading.closest("table").tBodies[0];
      const kind = heading.dataset.sort;
      const keyed = [...body.rows].map((row) => ({ row, key: keyOf(row, heading.cellIndex, kind) }));
      keyed.sort((one, other) => compare(one.key, other.key, kind, direction));
      body.append(...keyed.map((item) => item.row));
    });
  }

  // Wide tables: columns can be chosen and rows filtered; metrics are rows if there are few combinations.
  const MANY = 9, LEAST = 3, FEW_ROWS = 6;
  const isShown = (element) => !element.hidden;
  // The transposed table, with at most this many combinations as columns.
  const turned = (table, most) => {
    const bodyRows = [...table.tBodies[0].rows].filter(isShown);
    const headings = [...table.tHead.rows[0].cells].filter(isShown);
    const blocks = [];
    for (let start = 0; start < bodyRows.length; start += most) {
      const block = document.createElement("table");
      block.className = "turned";
      const top = block.createTHead().insertRow();
      const corner = document.createElement("th");
      corner.scope = "col";
      corner.textContent = "what";
      top.append(corner);
      for (const from of bodyRows.slice(start, start + most)) {
        const heading = document.createElement("th");
        heading.scope = "col";
        heading.className = "n";
        const names = [...from.cells].slice(0, table.dataset.names).filter((place) => place.textContent.trim() !== "-");
        // Keep the links in the names.
        names.forEach((place, index) => heading.append(index ? ", " : "", ...place.cloneNode(true).childNodes));
        top.append(heading);
      }
      const body = block.createTBody();
      for (const heading of headings.slice(Number(table.dataset.names))) {
        const row = body.insertRow();
        const first = document.createElement("th");
        first.scope = "row";
        for (const part of heading.childNodes) {
          if (part.nodeType !== Node.ELEMENT_NODE) { first.append(part.textContent); continue; }
          const copy = part.cloneNode(true);
          if (copy.tagName === "BUTTON") first.append(...copy.childNodes); else first.append(copy);
        }
        row.append(first);
        for (const from of bodyRows.slice(start, start + most)) row.append(from.cells[heading.cellIndex].cloneNode(true));
      }
      blocks.push(block);
    }
    return blocks;
  };
  for (const region of document.querySelectorAll("[data-chooser]")) {
    const table = region.querySelector("table");
    const headings = [...table.tHead.rows[0].cells];
    table.dataset.names = headings.findIndex((heading) => heading.dataset.name);
    if (table.dataset.names < 0) continue;
    const bar = document.createElement("div");
    bar.className = "chooser";
    const filter = Object.assign(document.createElement("input"), { type: "search", placeholder: "filter rows" });
    filter.setAttribute("aria-label", `filter the rows: ${region.getAttribute("aria-label")}`);
    const turn = Object.assign(document.createElement("button"), { type: "button" });
    const all = Object.assign(document.createElement("button"), { type: "button" });
    const details = document.createElement("details");
    const summary = Object.assign(document.createElement("summary"), { textContent: "choose columns" });
    const names = Object.assign(document.createElement("div"), { className: "names" });
    details.append(summary, names);
    bar.append(filter, turn, all, details);
    region.before(bar);
    const optional = headings.filter((heading) => heading.dataset.name);
    const boxes = optional.map((heading) => {
      const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
      const label = document.createElement("label");
      label.append(box, [...heading.querySelectorAll("button small, button")].pop()?.textContent.trim() ?? heading.textContent);
      names.append(label);
      box.addEventListener("change", () => draw());
      return box;
    });
    const judging = optional.map((heading) => "key" in heading.dataset);
    // If few columns measure quality, show the first ones of the workflow.
    const keys = judging.filter(Boolean).length < 4 ? optional.map((_, index) => index < MANY) : judging;
    const isMuch = optional.length > MANY || region.scrollWidth > region.clientWidth;
    let isTurned = region.dataset.chooser === "either" && isMuch && table.tBodies[0].rows.length <= FEW_ROWS;
    // If not all columns fit, show those that measure quality; a click shows all.
    const hide = (index) => {
      for (const row of table.rows) row.cells[optional[index].cellIndex].hidden = !boxes[index].checked;
    };
    if (!isTurned && isMuch && keys.some(Boolean)) {
      boxes.forEach((box, index) => { box.checked = keys[index]; hide(index); });
      for (let last; region.scrollWidth > region.clientWidth && keys.filter(Boolean).length > LEAST; hide(last)) {
        last = keys.lastIndexOf(true);
        boxes[last].checked = keys[last] = false;
      }
    }
    const draw = () => {
      optional.forEach((_, index) => hide(index));
      for (const row of table.tBodies[0].rows) {
        row.hidden = !row.textContent.toLowerCase().includes(filter.value.trim().toLowerCase());
      }
      const count = boxes.filter((box) => box.checked).length;
      summary.textContent = `choose columns (${count} of ${boxes.length})`;
      all.textContent = count === boxes.length ? "key columns only" : "all columns";
      all.hidden = !keys.some(Boolean) || keys.every(Boolean);
      turn.textContent = isTurned ? "combinations as rows" : "metrics as rows";
      region.replaceChildren(...(isTurned ? turned(table, Infinity) : [table]));
    };
    filter.addEventListener("input", draw);
    turn.addEventListener("click", () => { isTurned = !isTurned; draw(); });
    all.addEventListener("click", () => {
      const every = boxes.every((box) => box.checked);
      boxes.forEach((box, index) => { box.checked = !every || keys[index]; });
      draw();
    });
    draw();
    // Columns cannot be scrolled in print.
    addEventListener("beforeprint", () => {
      if (boxes.length <= 6) return;
      const paper = document.createElement("div");
      paper.className = "on-paper";
      for (const row of table.rows) for (const place of row.cells) place.hidden = false;
      paper.append(...turned(table, 5));
      region.classList.add("off-paper");
      region.after(paper);
    });
    addEventListener("afterprint", () => {
      if (region.nextElementSibling?.className === "on-paper") region.nextElementSibling.remove();
      region.classList.remove("off-paper");
      draw();
    });
  }

  // Pictures with few cells are enlarged, preserving their aspect ratio.
  for (const image of document.querySelectorAll(".raster .picture > img")) {
    const enlarge = () => {
      const { naturalWidth: width, naturalHeight: height } = image, longest = Math.max(width, height);
      if (!longest || longest >= 640) return;
      image.classList.add("few");
      image.style.width = `min(${640 * width / longest}px, calc(var(--high) * ${width / height}))`;
    };
    if (image.complete) enlarge();
    image.addEventListener("load", enlarge);
  }

  // Each picture is in the page once; copies refer to the first one.
  const pictureOf = (id) => {
    const copy = document.createElement("img");
    copy.src = document.querySelector(`#${CSS.escape(id)} img`).src;
    copy.alt = "";
    return copy;
  };

  // Two superimposed pictures of a wall, clipped at the dividing line.
  for (const slider of document.querySelectorAll("[data-slider]")) {
    const groups = JSON.parse(document.getElementById(slider.dataset.slider).textContent);
    const part = Object.fromEntries(
      [...slider.querySelectorAll("[data-part]")].map((element) => [element.dataset.part, element]));
    const fill = (select, names, chosen) => {
      select.replaceChildren(...names.map((name, index) => new Option(name, index, false, index === chosen)));
    };
    const layer = (picture) => {
      const image = pictureOf(picture.id);
      image.alt = picture.title;
      Object.assign(image.style, { left: `${picture.left}%`, top: `${picture.top}%`,
        width: `${picture.width}%`, height: `${picture.height}%` });
      const holder = document.createElement("div");
      holder.className = "layer";
      holder.append(image);
      return holder;
    };
    const line = document.createElement("div");
    line.className = "line";
    const cut = () => {
      const position = part.position.value;
      const [right, left] = part.stage.querySelectorAll(".layer");
      left.style.clipPath = `inset(0 ${100 - position}% 0 0)`;
      right.style.clipPath = `inset(0 0 0 ${position}%)`;
      line.style.left = `${position}%`;
    };
    // The selected layers are kept for other walls, and when the page is opened again.
    const memory = `orthoflow-slider-${slider.dataset.remember}`;
    let chosen = {};
    try { chosen = JSON.parse(store.read(memory)) ?? {}; } catch { /* nothing stored */ }
    const keep = () => store.write(memory, JSON.stringify(chosen));
    const layerOf = (select) => groups[part.wall.value].pictures[select.value].layer;
    const lay = () => {
      const { pictures } = groups[part.wall.value];
      part.stage.replaceChildren(layer(pictures[part.right.value]), layer(pictures[part.left.value]), line);
      cut();
    };
    const choose = () => {
      const { pictures, ratio } = groups[part.wall.value];
      const names = pictures.map((picture) => picture.layer);
      // If only one step has variants, its name is redundant and is omitted to save space.
      const steps = new Set(names.flatMap((name) => [...name.matchAll(/([^\s(,=]+)=/g)].map((found) => found[1])));
      const labels = steps.size === 1 ? names.map((name) => name.replace(`${[...steps][0]}=`, "")) : names;
      const at = (name, otherwise) => {
        const found = pictures.findIndex((picture) => picture.layer === name);
        return found < 0 ? otherwise : found;
      };
      const left = at(chosen.left, 0);
      fill(part.left, labels, left);
      fill(part.right, labels, at(chosen.right, left === 1 ? 0 : 1));
      part.stage.style.aspectRatio = ratio;
      part.stage.style.width = `min(100%, calc(75vh * ${ratio}))`;
      lay();
    };
    const wall = groups.findIndex((group) => group.name === chosen.wall);
    fill(part.wall, groups.map((group) => group.name), Math.max(0, wall));
    if (chosen.position) part.position.value = chosen.position;
    const changed = () => {
      chosen = { wall: groups[part.wall.value].name, left: layerOf(part.left), right: layerOf(part.right),
        position: part.position.value };
      keep();
    };
    part.wall.addEventListener("change", () => { choose(); changed(); });
    part.left.addEventListener("change", () => { lay(); changed(); });
    part.right.addEventListener("change", () => { lay(); changed(); });
    part.position.addEventListener("input", () => { cut(); changed(); });
    const drag = (event) => {
      if (event.buttons === 0 && event.type !== "pointerdown") return;
      const box = part.stage.getBoundingClientRect();
      part.position.value = (100 * (event.clientX - box.left)) / box.width;
      cut();
      changed();
    };
    part.stage.addEventListener("pointerdown", drag);
    part.stage.addEventListener("pointermove", drag);
    choose();
  }

  // Orthoimages show coordinates at the cursor; clicks collect check points or ties.
  const pointing = new Map();
  for (const panel of document.querySelectorAll("[data-points]")) {
    const places = JSON.parse(document.getElementById(panel.dataset.points).textContent);
    const photos = panel.querySelector("datalist").id;
    const part = Object.fromEntries(
      [...panel.querySelectorAll("[data-part]")].map((element) => [element.dataset.part, element]));
    const points = [];
    const under = (place, image, event) => {
      // The enlarged view scales the bounding box, but not offsetWidth and offsetHeight.
      const box = image.getBoundingClientRect(), across = box.width / image.offsetWidth, down = box.height / image.offsetHeight;
      const x = ((event.clientX - box.left) / across - image.clientLeft) / image.clientWidth;
      const y = ((event.clientY - box.top) / down - image.clientTop) / image.clientHeight;
      if (!(x >= 0 && x < 1 && y >= 0 && y < 1)) return null;
      const u = x * place.width, v = y * place.height;
      const known = place.mm.length > 0
        ? place.mm[Math.floor(y * place.rows) * place.columns + Math.floor(x * place.columns)] : null;
      const depth = known === null ? NaN : known / 1000;
      let [right, below, before] = [place.gsd * u, place.gsd * v, known === null ? 0 : depth];
      if (place.bend) {
        // A curved wall: the distance along a generatrix and the angle about the axis.
        const { start, axes, place_m, along, aside, radius_m, sine, cosine, side, fan, is_sphere } = place.bend;
        const [p, q] = [right - place_m[0], below - place_m[1]];
        const [straight, across] = [along, aside].map((way) => p * way[0] + q * way[1]);
        const distance = fan ? Math.hypot(straight, across) : straight;
        const angle = fan ? Math.atan2(across, straight) / fan : across / radius_m;
        const outer = radius_m + side * before, turned = distance / radius_m;
        const [radius, axial] = is_sphere ? [outer * Math.sin(turned), -outer * Math.cos(turned)]
          : [radius_m + sine * distance + side * cosine * before, cosine * distance - side * sine * before];
        const about = [radius * Math.cos(angle), radius * Math.sin(angle), axial];
        [right, below, before] = start.map((value, axis) => about.reduce((sum, part, k) => sum + part * axes[k][axis], value));
      }
      const world = [0, 1, 2].map((axis) => place.origin[axis]
        + right * place.u[axis] + below * place.v[axis] + before * place.n[axis]);
      return { id: place.id, x, y, wall: place.wall, of: place.name, u, v, depth, world };
    };
    const words = (point) => `u ${point.u.toFixed(1)} px, v ${point.v.toFixed(1)} px, depth ${
      Number.isNaN(point.depth) ? "unknown (plane used)" : `${point.depth.toFixed(3)} m`}, ${
      point.world.map((value, axis) => `${"xyz"[axis]} ${value.toFixed(3)}`).join(", ")} m`;
    const field = (label, size, hint, list) => {
      const input = document.createElement("input");
      input.setAttribute("aria-label", label);
      input.placeholder = hint;
      input.size = size;
      if (list) input.setAttribute("list", list);
      return input;
    };
    // A numbered cross at each collected point, in both views.
    const cross = (point) => {
      const mark = document.createElement("span"), number = document.createElement("b");
      Object.assign(mark.style, { left: `${100 * point.x}%`, top: `${100 * point.y}%` });
      number.textContent = point.number;
      mark.append(number);
      return mark;
    };
    const update = () => {
      for (const { id } of places) for (const box of document.querySelectorAll(`[data-marks="${id}"]`)) {
        box.replaceChildren(...points.filter((point) => point.id === id).map(cross));
      }
      part.checkpoints.disabled = part.ties.disabled = points.length === 0;
      part.message.textContent = "";
    };
    const collect = (point) => {
      const row = document.createElement("div");
      const number = 1 + Math.max(0, ...points.map((other) => other.number));
      const name = field(`name of point ${number}`, 8, "name");
      name.value = `P${number}`;
      const entry = { ...point, number, name, photo: field(`photo of point ${number}`, 14, "photo", photos),
        photoU: field(`u of point ${number} in the photo`, 8, "u / px"), photoV: field(`v of point ${number} in the photo`, 8, "v / px") };
      const remove = document.createElement("button");
      remove.type = "button";
      remove.textContent = "remove";
      remove.setAttribute("aria-label", `remove point ${number}`);
      remove.addEventListener("click", () => {
        points.splice(points.indexOf(entry), 1);
        row.remove();
        update();
      });
      const source = document.createElement("span");
      source.textContent = `${point.of}, ${words(point)}`;
      row.append(name, entry.photo, entry.photoU, entry.photoV, remove, source);
      part.list.append(row);
      points.push(entry);
      update();
      return name.value;
    };
    const cell = (value) => {
      const text = typeof value === "number" ? String(Number(value.toFixed(4))) : value.trim();
      return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    };
    const save = (file, header, rows) => {
      const lines = [header, ...rows.map((row) => row.map(cell))].map((row) => row.join(","));
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" }));
      link.download = file;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 60000);
    };
    part.checkpoints.addEventListener("click", () => {
      // shown_x and shown_y are independent of the cell size; x, y, z are to be filled in from the survey.
      save("checkpoints.csv", ["name", "x", "y", "z", "wall", "shown_x", "shown_y", "shown_z"],
        points.map((point) => [point.name.value, ...point.world, point.wall, ...point.world]));
      part.message.textContent = `${points.length} check points saved: add the surveyed x, y, z to the file`;
    });
    part.ties.addEventListener("click", () => {
      const isNumber = (input) => input.value.trim() !== "" && Number.isFinite(Number(input.value));
      const whole = points.filter((point) =>
        point.photo.value.trim() && isNumber(point.photoU) && isNumber(point.photoV));
      const left = points.length - whole.length;
      const lacking = left ? `; ${left} points without a photo or pixel position are omitted` : "";
      part.message.textContent = `${whole.length} ties${lacking}`;
      if (whole.length) save("ties.csv", ["photo", "u_px", "v_px", "x", "y", "z"], whole.map((point) =>
        [point.photo.value, Number(point.photoU.value), Number(point.photoV.value), ...point.world]));
    });
    for (const place of places) {
      const figure = document.getElementById(place.id);
      const image = figure.querySelector("img");
      const readout = figure.querySelector(".readout");
      const marks = document.createElement("div");
      marks.className = "marks";
      marks.dataset.marks = place.id;
      figure.querySelector(".picture").append(marks);
      new ResizeObserver(() => Object.assign(marks.style, {
        left: `${image.offsetLeft + image.clientLeft}px`, top: `${image.offsetTop + image.clientTop}px`,
        width: `${image.clientWidth}px`, height: `${image.clientHeight}px`,
      })).observe(image);
      const collected = (point) => `${collect(point)} collected: ${words(point)}`;
      let pointer = null;
      const follow = (event) => {
        const point = under(place, image, event);
        pointer = { clientX: event.clientX, clientY: event.clientY };
        if (point) readout.textContent = words(point);
      };
      image.addEventListener("pointermove", follow);
      image.addEventListener("pointerdown", follow);
      image.addEventListener("click", (event) => {
        // Click events have whole pixels; the preceding pointer event has subpixel coordinates.
        const isIts = pointer && Math.abs(pointer.clientX - event.clientX) < 1 && Math.abs(pointer.clientY - event.clientY) < 1;
        const point = under(place, image, isIts ? pointer : event);
        if (point) readout.textContent = collected(point);
      });
      pointing.set(figure, (copy, event, isClick) => {
        const point = under(place, copy, event);
        if (!point) return "";
        return isClick ? collected(point) : words(point);
      });
    }
  }

  // Enlarged view of all pictures: drag and wheel, arrow keys for the next one, a link to the file.
  const viewer = document.getElementById("viewer");
  const view = Object.fromEntries(
    [...viewer.querySelectorAll("[data-part]")].map((element) => [element.dataset.part, element]));
  const every = [...document.querySelectorAll("figure[data-large]")];
  // Arrow keys step through the pictures that are not collapsed.
  const unfolded = () => every.filter((figure) => !figure.closest("details:not([open])"));
  let now = null, place = { scale: 1, x: 0, y: 0 }, size = { width: 1, height: 1, cells: 1, metres: 0 };
  const lie = () => {
    const shown = view.stage.firstElementChild;
    shown.style.transform = `translate(${place.x}px, ${place.y}px) scale(${place.scale})`;
    shown.style.setProperty("--back", 1 / place.scale);
    const perCell = (place.scale * size.width) / size.cells;
    shown.classList.toggle("cells", perCell > 2);
    const whole = size.metres ? `, 10 cm are ${Math.round((0.1 * place.scale * size.width) / size.metres)} px` : "";
    view.scale.textContent = `${Math.round(100 * perCell)} %${whole}`;
  };
  const fit = () => {
    const { clientWidth, clientHeight } = view.stage;
    const scale = Math.min(clientWidth / size.width, clientHeight / size.height);
    place = { scale, x: (clientWidth - scale * size.width) / 2, y: (clientHeight - scale * size.height) / 2 };
    lie();
  };
  const zoom = (factor, x = view.stage.clientWidth / 2, y = view.stage.clientHeight / 2) => {
    const scale = Math.min(60, Math.max(0.02, place.scale * factor));
    const kept = scale / place.scale;
    place = { scale, x: x - kept * (x - place.x), y: y - kept * (y - place.y) };
    lie();
  };
  const open = (figure) => {
    now = figure;
    const picture = figure.querySelector(".picture");
    const image = picture.querySelector("img"), box = image.getBoundingClientRect();
    const natural = { width: image.naturalWidth || box.width, height: image.naturalHeight || box.height };
    size = { ...natural, cells: natural.width, metres: Number(figure.dataset.widthM ?? 0) };
    const shown = document.createElement("div");
    shown.className = `shown ${figure.className}`;
    shown.append(image.cloneNode(true));
    shown.querySelector("img.few")?.removeAttribute("style");
    const marks = picture.querySelector(":scope > .marks")?.cloneNode(true);
    if (marks) { marks.removeAttribute("style"); shown.append(marks); }
    Object.assign(shown.style, { width: `${size.width}px`, height: `${size.height}px` });
    view.stage.replaceChildren(shown);
    view.caption.textContent = [...figure.querySelectorAll("figcaption strong, figcaption .soft")]
      .map((part) => part.textContent.trim().replace(/\s+/g, " ")).join(": ");
    const pages = unfolded();
    view.place.textContent = `${pages.indexOf(figure) + 1} of ${pages.length}`;
    const isPointed = pointing.has(figure);
    view.readout.textContent = isPointed ? "move for coordinates, click to collect a point" : "";
    view.readout.parentElement.hidden = !isPointed;
    view.stage.style.cursor = isPointed ? "crosshair" : "";
    view.colours.replaceChildren(...[...picture.querySelectorAll(":scope > .depths")].map((bar) => bar.cloneNode(true)));
    const file = figure.querySelector("a.file");
    view.file.replaceChildren(...(file ? [Object.assign(file.cloneNode(), { textContent: "open the file" })] : []));
    if (!viewer.open) viewer.showModal();
    view.stage.focus();
    fit();
  };
  const go = (step) => {
    const pages = unfolded();
    open(pages[(pages.indexOf(now) + step + pages.length) % pages.length]);
  };
  every.forEach((figure) => {
    const button = Object.assign(document.createElement("button"), { type: "button", className: "enlarge", textContent: "⤢" });
    button.setAttribute("aria-label", `enlarge: ${figure.querySelector("figcaption strong").textContent}`);
    button.addEventListener("click", () => open(figure));
    const picture = figure.querySelector(".picture");
    picture.append(button);
    // On orthoimages and walls, a click collects a point instead.
    if (!figure.classList.contains("raster")) {
      picture.querySelector("img").addEventListener("click", () => open(figure));
    }
  });
  view.previous.addEventListener("click", () => go(-1));
  view.next.addEventListener("click", () => go(1));
  view.in.addEventListener("click", () => zoom(1.5));
  view.out.addEventListener("click", () => zoom(1 / 1.5));
  view.fit.addEventListener("click", fit);
  view.close.addEventListener("click", () => viewer.close());
  viewer.addEventListener("keydown", (event) => {
    const keys = { ArrowLeft: () => go(-1), ArrowRight: () => go(1), "+": () => zoom(1.5), "-": () => zoom(1 / 1.5), 0: fit };
    if (!(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
  view.stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = view.stage.getBoundingClientRect();
    zoom(Math.exp(-event.deltaY / 400), event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
  const point = (event, isClick) => {
    const text = pointing.get(now)?.(view.stage.querySelector("img"), event, isClick);
    if (text) view.readout.textContent = text;
  };
  // Position of pointerdown, while it may still become a click; larger movements are drags.
  const TREMBLE_PX = 3;
  let pressed = null;
  view.stage.addEventListener("pointerdown", (event) => {
    view.stage.setPointerCapture(event.pointerId);
    pressed = event.button === 0 ? { x: event.clientX, y: event.clientY } : null;
  });
  view.stage.addEventListener("pointerup", (event) => {
    if (pressed) point(event, true);
    pressed = null;
  });
  view.stage.addEventListener("pointermove", (event) => {
    if (!view.stage.hasPointerCapture(event.pointerId)) { point(event, false); return; }
    if (pressed && Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) <= TREMBLE_PX) return;
    pressed = null;
    place = { ...place, x: place.x + event.movementX, y: place.y + event.movementY };
    lie();
  });
  addEventListener("resize", () => { if (viewer.open) fit(); });

  // Contents: a fixed column, collapsed on narrow screens; the current section is highlighted.
  const contents = document.querySelector(".contents details");
  const wide = matchMedia("(min-width: 72rem)");
  wide.addEventListener("change", () => { contents.open = wide.matches; });
  const anchors = [...contents.querySelectorAll("a")].map((link) => ({ link, target: document.getElementById(link.hash.slice(1)) }))
    .filter(({ target }) => target);
  const mark = () => {
    const above = anchors.filter(({ target }) => target.getBoundingClientRect().top < 140);
    const current = (above.length ? above[above.length - 1] : anchors[0])?.link;
    for (const { link } of anchors) {
      if (link === current) link.setAttribute("aria-current", "true"); else link.removeAttribute("aria-current");
    }
  };
  let isWaiting = false;
  addEventListener("scroll", () => {
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame(() => { isWaiting = false; mark(); });
  }, { passive: true });
  mark();
  contents.addEventListener("click", (event) => { if (event.target.closest("a") && !wide.matches) contents.open = false; });
  // Expand collapsed parts that contain the target of a link.
  const unfoldTarget = () => {
    const target = location.hash && document.getElementById(location.hash.slice(1));
    for (let at = target; at; at = at.parentElement) if (at.tagName === "DETAILS") at.open = true;
  };
  addEventListener("hashchange", unfoldTarget);
  unfoldTarget();

  // Browsers store pictures uncompressed in PDFs, except JPEG: JPEG copies for printing are made while the page
  // is idle, since there is no time for it when printing starts.
  const PAPER_PX = 1100, LARGE_PNG = 130000;
  const onPaper = new Map(), made = new Map();
  const paperOf = (image) => {
    // The same picture may be used several times.
    if (made.has(image.src)) return made.get(image.src);
    const scale = Math.min(1, PAPER_PX / Math.max(image.naturalWidth, image.naturalHeight));
    const canvas = document.createElement("canvas");
    canvas.width = Math.max(1, Math.round(scale * image.naturalWidth));
    canvas.height = Math.max(1, Math.round(scale * image.naturalHeight));
    const brush = canvas.getContext("2d");
    brush.fillStyle = "#fff";
    brush.fillRect(0, 0, canvas.width, canvas.height);
    brush.fillStyle = "#dcdcdc";
    for (let y = 0; y < canvas.height; y += 8) for (let x = y % 16; x < canvas.width; x += 16) brush.fillRect(x, y, 8, 8);
    brush.drawImage(image, 0, 0, canvas.width, canvas.height);
    const copy = new Image();
    copy.src = canvas.toDataURL("image/jpeg", 0.75);
    made.set(image.src, copy);
    return copy;
  };
  const waiting = [...document.images].filter((image) => !image.closest(".way, .stage, .earlier") && image.naturalWidth > 200
    && (image.src.startsWith("data:image/webp") || (image.src.startsWith("data:image/png") && image.src.length > LARGE_PNG)));
  const later = window.requestIdleCallback ?? ((work) => setTimeout(work, 50));
  const prepare = () => {
    const image = waiting.shift();
    if (!image) { root.dataset.paper = "ready"; return; }
    onPaper.set(image, paperOf(image));
    later(prepare);
  };
  addEventListener("load", () => later(prepare));
  let onScreen = [];
  addEventListener("beforeprint", () => {
    onScreen = [...onPaper].filter(([, copy]) => copy.complete).map(([image, copy]) => {
      const was = image.src;
      image.src = copy.src;
      return [image, was];
    });
  });
  addEventListener("afterprint", () => { for (const [image, was] of onScreen) image.src = was; });

  // In print, results are expanded; other parts only if the reader expanded them.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll(":is(details.paper, .warnings details):not([open])")]
      .filter((group) => !group.closest(".way"));
    for (const group of folded) group.open = true;
  });
  addEventListener("afterprint", () => { for (const group of folded) group.open = false; });
})();
