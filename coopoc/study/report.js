"use strict";
// What the page does beyond being read: sort a table, switch the noise model, mark the place in the contents.
// Without it every row and every panel is there.
(() => {
  const SECONDS = { s: 1, min: 60, h: 3600 };
  const NUMBER = /^([+\-−]?)(\d[\d,]*\.?\d*(?:e[+-]?\d+)?|inf)(?:\s+(s|min|h)$)?/;
  const words = new Intl.Collator("en", { numeric: true });
  document.documentElement.classList.add("js");

  // The first number of a cell, which is the mean of an interval; durations in seconds; undefined for other text.
  function number(text) {
    const found = NUMBER.exec(text);
    if (!found) return undefined;
    const size = found[2] === "inf" ? Infinity : Number(found[2].replaceAll(",", ""));
    return (found[1] && found[1] !== "+" ? -size : size) * (SECONDS[found[3]] ?? 1);
  }

  // The rows in the order of one column; cells without a value stay last in both directions.
  function ordered(rows, column, sign) {
    const texts = new Map(rows.map((row) => [row, row.cells[column].textContent.trim()]));
    const given = rows.filter((row) => !["", "–"].includes(texts.get(row)));
    const numbers = new Map(given.map((row) => [row, number(texts.get(row))]));
    const plain = given.every((row) => numbers.get(row) !== undefined);
    const compare = plain
      ? (a, b) => (numbers.get(a) === numbers.get(b) ? 0 : numbers.get(a) - numbers.get(b)) // inf - inf is no number
      : (a, b) => words.compare(texts.get(a), texts.get(b));
    given.sort((a, b) => sign * compare(a, b));
    return [...given, ...rows.filter((row) => !numbers.has(row))];
  }

  // A click sorts upwards, the next one downwards, the third gives the order of the study back.
  function sortable(table) {
    const body = table.tBodies[0];
    const original = [...body.rows];
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => {
      const button = document.createElement("button");
      button.type = "button";
      button.className = "sort";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => {
        const next = { ascending: "descending", descending: "" }[head.getAttribute("aria-sort")] ?? "ascending";
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        if (next) head.setAttribute("aria-sort", next);
        body.append(...(next ? ordered(original, column, next === "ascending" ? 1 : -1) : original));
      });
    });
  }

  // Tabs over the panels of a block; all blocks that have a panel of the chosen noise model follow.
  function tabs(block) {
    const panels = [...block.children];
    const list = document.createElement("div");
    list.className = "tabs";
    list.setAttribute("role", "tablist");
    list.setAttribute("aria-label", "Noise model");
    const buttons = panels.map((panel) => {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", id: `${panel.id}-tab`, textContent: panel.dataset.noise_model });
      button.setAttribute("role", "tab");
      button.setAttribute("aria-controls", panel.id);
      panel.setAttribute("role", "tabpanel");
      panel.setAttribute("aria-labelledby", button.id);
      return button;
    });
    const show = (model) => {
      const at = panels.findIndex((panel) => panel.dataset.noise_model === model);
      if (at < 0) return;
      panels.forEach((panel, i) => panel.classList.toggle("other", i !== at));
      buttons.forEach((button, i) => {
        button.setAttribute("aria-selected", String(i === at));
        button.tabIndex = i === at ? 0 : -1;
      });
    };
    const choose = (button) => {
      const before = button.getBoundingClientRect().top;
      blocks.forEach((each) => each(button.textContent));
      button.focus({ preventScroll: true });
      window.scrollBy({ top: button.getBoundingClientRect().top - before, behavior: "instant" });
    };
    buttons.forEach((button, i) => {
      button.addEventListener("click", () => choose(button));
      button.addEventListener("keydown", (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!step) return;
        event.preventDefault();
        choose(buttons[(i + step + buttons.length) % buttons.length]);
      });
    });
    list.append(...buttons);
    block.prepend(list);
    show(panels[0].dataset.noise_model);
    return show;
  }

  // On a phone a figure fits; this one draws it large enough to read, in a box that scrolls.
  function enlargeable(figure) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", className: "enlarge", textContent: "Enlarge" });
    button.addEventListener("click", () => {
      button.textContent = figure.classList.toggle("large") ? "Fit" : "Enlarge";
    });
    (figure.querySelector(".files") ?? figure.querySelector("figcaption")).append(button);
  }

  // A pointer near a mark shows its numbers; buttons hide and show the lines of a method, marks and legend with them.
  const NEAR = 0.05; // of the figure's width
  function explorable(drawing) {
    const marks = JSON.parse(drawing.dataset.marks);
    const [spot, tip] = ["spot", "tip"].map((name) => {
      const part = document.createElement("div");
      Object.assign(part, { className: name, hidden: true });
      drawing.append(part);
      return part;
    });
    const absent = new Set();
    drawing.addEventListener("pointermove", (event) => {
      const box = drawing.getBoundingClientRect();
      const x = (event.clientX - box.left) / box.width;
      const y = (event.clientY - box.top) / box.height;
      let best = NEAR;
      let found;
      for (const mark of marks) {
        const far = Math.hypot(mark.at[0] - x, ((mark.at[1] - y) * box.height) / box.width);
        if (far < best && !absent.has(mark.series)) [best, found] = [far, mark];
      }
      spot.hidden = tip.hidden = !found;
      if (!found) return;
      tip.textContent = found.text;
      const centre = Math.min(Math.max(found.at[0] * box.width, 100), box.width - 100);
      spot.style.left = `${100 * found.at[0]}%`;
      tip.style.left = `${centre}px`;
      tip.classList.toggle("below", found.at[1] * box.height < 48);
      spot.style.top = tip.style.top = `${100 * found.at[1]}%`;
    });
    drawing.addEventListener("pointerleave", () => (spot.hidden = tip.hidden = true));
    const names = new Map(marks.map((mark) => [mark.series, mark.name]));
    if (names.size < 2) return;
    const list = document.createElement("div");
    list.className = "chosen";
    list.setAttribute("role", "group");
    list.setAttribute("aria-label", "Lines of the figure");
    for (const [series, name] of names) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: name });
      button.setAttribute("aria-pressed", "true");
      button.addEventListener("click", () => {
        const away = button.getAttribute("aria-pressed") === "true";
        button.setAttribute("aria-pressed", String(!away));
        if (away) absent.add(series);
        else absent.delete(series);
        drawing.querySelectorAll("[data-series]").forEach((part) => {
          if (part.dataset.series === series) part.classList.toggle("absent", away);
        });
      });
      list.append(button);
    }
    drawing.closest(".wide").after(list);
  }

  // The last section whose head has come past the upper third of the window is the one that is read.
  function mark() {
    const links = [...document.querySelectorAll("nav a")];
    const heads = links.map((link) => document.getElementById(link.hash.slice(1)));
    const end = window.scrollY > 0 && window.innerHeight + window.scrollY >= document.body.scrollHeight - 2;
    const passed = heads.findLastIndex((head) => head.getBoundingClientRect().top < window.innerHeight / 3);
    const here = end ? links.length - 1 : passed;
    links.forEach((link, i) => (i === here ? link.setAttribute("aria-current", "true") : link.removeAttribute("aria-current")));
  }

  [...document.querySelectorAll("table")].filter((table) => table.tHead).forEach(sortable);
  const blocks = [...document.querySelectorAll(".block")].map(tabs);
  document.querySelectorAll("figure").forEach(enlargeable);
  document.querySelectorAll(".drawing").forEach(explorable);
  document.addEventListener("scroll", mark, { passive: true });
  mark();
})();
