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

  // On paper nothing can be unfolded.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("details.group:not([open])")];
    for (const group of folded) group.open = true;
  });
  addEventListener("afterprint", () => { for (const group of folded) group.open = false; });
})();
