"use strict";
(() => {
  const root = document.documentElement;
  root.classList.add("scripted");

  // Colours: as the system, light, dark. What was chosen is remembered where the browser allows it.
  const themes = { auto: "as the system", light: "light", dark: "dark" };
  const store = {
    get() { try { return localStorage.getItem("orthoflow-theme"); } catch { return null; } },
    set(name) { try { localStorage.setItem("orthoflow-theme", name); } catch { /* private windows */ } },
  };
  const button = document.getElementById("theme");
  const show = (name) => {
    if (name === "auto") root.removeAttribute("data-theme"); else root.dataset.theme = name;
    button.textContent = `colours: ${themes[name]}`;
    button.setAttribute("aria-label", button.textContent);
  };
  let theme = store.get() in themes ? store.get() : "auto";
  show(theme);
  button.addEventListener("click", () => {
    const names = Object.keys(themes);
    theme = names[(names.indexOf(theme) + 1) % names.length];
    store.set(theme);
    show(theme);
  });

  // Tables: a heading with data-sort becomes a button. Rows without a value stay last either way.
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

  // Pictures are in the page once; where one is needed again, it is taken from its first place.
  const pictureOf = (id) => {
    const copy = document.createElement("img");
    copy.src = document.querySelector(`#${CSS.escape(id)} img`).src;
    copy.alt = "";
    return copy;
  };
  for (const stack of document.querySelectorAll("[data-ground]")) {
    if (stack.dataset.ground) stack.prepend(pictureOf(stack.dataset.ground));
  }

  // Two pictures of a wall, the left one cut off at the dividing line.
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
    const lay = () => {
      const { pictures } = groups[part.wall.value];
      part.stage.replaceChildren(layer(pictures[part.right.value]), layer(pictures[part.left.value]), line);
      cut();
    };
    const choose = () => {
      const { pictures, ratio } = groups[part.wall.value];
      const names = pictures.map((picture) => picture.title);
      fill(part.left, names, 0);
      fill(part.right, names, 1);
      part.stage.style.aspectRatio = ratio;
      part.stage.style.width = `min(100%, calc(75vh * ${ratio}))`;
      lay();
    };
    fill(part.wall, groups.map((group) => group.name), 0);
    part.wall.addEventListener("change", choose);
    part.left.addEventListener("change", lay);
    part.right.addEventListener("change", lay);
    part.position.addEventListener("input", cut);
    const drag = (event) => {
      if (event.buttons === 0 && event.type !== "pointerdown") return;
      const box = part.stage.getBoundingClientRect();
      part.position.value = (100 * (event.clientX - box.left)) / box.width;
      cut();
    };
    part.stage.addEventListener("pointerdown", drag);
    part.stage.addEventListener("pointermove", drag);
    choose();
  }

  // Orthoimages tell what lies under the cursor, and clicks are collected as check points or ties.
  for (const panel of document.querySelectorAll("[data-points]")) {
    const places = JSON.parse(document.getElementById(panel.dataset.points).textContent);
    const photos = panel.querySelector("datalist").id;
    const part = Object.fromEntries(
      [...panel.querySelectorAll("[data-part]")].map((element) => [element.dataset.part, element]));
    const points = [];
    const under = (place, image, event) => {
      const box = image.getBoundingClientRect();
      const x = (event.clientX - box.left - image.clientLeft) / image.clientWidth;
      const y = (event.clientY - box.top - image.clientTop) / image.clientHeight;
      if (!(x >= 0 && x < 1 && y >= 0 && y < 1)) return null;
      const u = x * place.width, v = y * place.height;
      const known = place.mm.length > 0
        ? place.mm[Math.floor(y * place.rows) * place.columns + Math.floor(x * place.columns)] : null;
      const depth = known === null ? NaN : known / 1000;
      const world = [0, 1, 2].map((axis) => place.origin[axis]
        + place.gsd * (u * place.u[axis] + v * place.v[axis]) + (known === null ? 0 : depth) * place.n[axis]);
      return { wall: place.wall, of: place.name, u, v, depth, world };
    };
    const words = (point) => `u ${point.u.toFixed(1)} px, v ${point.v.toFixed(1)} px, depth ${
      Number.isNaN(point.depth) ? "unknown (the plane is taken)" : `${point.depth.toFixed(3)} m`}, x ${
      point.world.map((value) => value.toFixed(3)).join(", ")} m`;
    const field = (label, size, list) => {
      const input = document.createElement("input");
      input.setAttribute("aria-label", label);
      input.placeholder = label;
      input.size = size;
      if (list) input.setAttribute("list", list);
      return input;
    };
    const update = () => {
      part.checkpoints.disabled = part.ties.disabled = points.length === 0;
      part.told.textContent = "";
    };
    const collect = (point) => {
      const row = document.createElement("div");
      const number = 1 + Math.max(0, ...points.map((other) => other.number));
      const name = field(`name of point ${number}`, 8);
      name.value = `P${number}`;
      const entry = { ...point, number, name, photo: field(`photo of point ${number}`, 12, photos),
        photoU: field("u in the photo", 8), photoV: field("v in the photo", 8) };
      const remove = document.createElement("button");
      remove.type = "button";
      remove.textContent = "remove";
      remove.setAttribute("aria-label", `remove point ${number}`);
      remove.addEventListener("click", () => {
        points.splice(points.indexOf(entry), 1);
        row.remove();
        update();
      });
      const told = document.createElement("span");
      told.textContent = `${point.of}, ${words(point)}`;
      row.append(name, told, entry.photo, entry.photoU, entry.photoV, remove);
      part.list.append(row);
      points.push(entry);
      update();
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
      save("checkpoints.csv", ["name", "x", "y", "z", "wall", "u_px", "v_px"],
        points.map((point) => [point.name.value, ...point.world, point.wall, point.u, point.v]));
      part.told.textContent = `${points.length} check points`;
    });
    part.ties.addEventListener("click", () => {
      const isNumber = (input) => input.value.trim() !== "" && Number.isFinite(Number(input.value));
      const whole = points.filter((point) =>
        point.photo.value.trim() && isNumber(point.photoU) && isNumber(point.photoV));
      const left = points.length - whole.length;
      const lacking = left ? `; ${left} points lack a photo or where it shows them, and are left out` : "";
      part.told.textContent = `${whole.length} ties${lacking}`;
      if (whole.length) save("ties.csv", ["photo", "u_px", "v_px", "x", "y", "z"], whole.map((point) =>
        [point.photo.value, Number(point.photoU.value), Number(point.photoV.value), ...point.world]));
    });
    for (const place of places) {
      const figure = document.getElementById(place.id);
      const image = figure.querySelector("img");
      const readout = document.createElement("output");
      readout.className = "readout";
      readout.textContent = "move over the picture for coordinates";
      figure.querySelector("figcaption").append(readout);
      image.addEventListener("pointermove", (event) => {
        const point = under(place, image, event);
        if (point) readout.textContent = words(point);
      });
      image.addEventListener("click", (event) => {
        const point = under(place, image, event);
        if (point) collect(point);
      });
    }
  }

  // On paper nothing can be unfolded.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("details.group:not([open])")];
    for (const group of folded) group.open = true;
  });
  addEventListener("afterprint", () => { for (const group of folded) group.open = false; });
})();
