"use strict";
// What the page does beyond being read: sort a table, enlarge a figure, mark the place in the contents.
// Without it all is there.
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

  // On a phone a figure fits; this one draws it large enough to read, in a box that scrolls.
  function enlargeable(figure) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", className: "enlarge", textContent: "Enlarge" });
    button.addEventListener("click", () => {
      button.textContent = figure.classList.toggle("large") ? "Fit" : "Enlarge";
    });
    figure.querySelector("figcaption").append(button);
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
  document.querySelectorAll("figure").forEach(enlargeable);
  document.addEventListener("scroll", mark, { passive: true });
  mark();
})();
