"use strict";
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  document.documentElement.classList.add("js");

  // Sliders: the handle below, or the pointer on the picture itself.
  for (const slider of all(".slider")) {
    const [area, range] = [slider.querySelector("div"), slider.querySelector("input")];
    const cut = (percent) => {
      range.value = percent;
      slider.style.setProperty("--cut", `${percent}%`);
    };
    range.addEventListener("input", () => cut(range.value));
    const follow = (event) => {
      const box = area.getBoundingClientRect();
      cut(Math.max(0, Math.min(100, (100 * (event.clientX - box.left)) / box.width)));
    };
    area.addEventListener("pointerdown", follow);
    area.addEventListener("pointermove", (event) => {
      if (event.pointerType === "mouse" || event.buttons) follow(event);
    });
    area.addEventListener("dragstart", (event) => event.preventDefault());
  }

  // Pictures enlarge on a click or on Enter; sliders follow the pointer instead. Figures are drawn in the page.
  const enlarged = document.querySelector("#enlarged");
  const enlarge = (picture) => {
    const copy = enlarged.querySelector("img");
    const drawn = picture.tagName === "svg";
    copy.src = drawn
      ? `data:image/svg+xml,${encodeURIComponent(new XMLSerializer().serializeToString(picture))}`
      : picture.src;
    copy.alt = drawn ? picture.closest("figure").querySelector("figcaption").textContent : picture.alt;
    enlarged.querySelector("figcaption").textContent = copy.alt;
    enlarged.showModal();
  };
  for (const picture of all(".grid img, .gallery figure > img, .plots > img, .plots > svg")) {
    if (picture.closest(".slider")) continue;
    picture.tabIndex = 0;
    picture.addEventListener("click", () => enlarge(picture));
    picture.addEventListener("keydown", (event) => event.key === "Enter" && enlarge(picture));
  }
  enlarged.addEventListener("click", () => enlarged.close());

  // Tables: a click on a column's head sorts by it, numbers by value, undefined ones last.
  const value = (row, column) => {
    const text = row.cells[column].textContent.trim();
    const number = parseFloat(text.replace("\u2212", "-"));
    return [text, text === "\u2013" ? NaN : number];
  };
  for (const head of all("thead th")) {
    head.tabIndex = 0;
    const sort = () => {
      const [table, column] = [head.closest("table"), head.cellIndex];
      const up = head.getAttribute("aria-sort") !== "ascending";
      const rows = all("tbody tr", table).map((row) => [row, ...value(row, column)]);
      const numeric = rows.some(([, , number]) => !Number.isNaN(number));
      rows.sort(([, a, x], [, b, y]) => {
        if (!numeric) return up ? a.localeCompare(b) : b.localeCompare(a);
        if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
        return up ? x - y : y - x;
      });
      all("th", table).forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      table.tBodies[0].append(...rows.map(([row]) => row));
    };
    head.addEventListener("click", sort);
    head.addEventListener("keydown", (event) => event.key === "Enter" && sort());
  }

  // Pictures: any two of a view over each other.
  for (const picker of all(".picker")) {
    const views = new Map();
    let view = null;
    for (const title of all(".all > h3", picker.parentNode)) {
      const bold = title.querySelector("strong");
      if (bold) views.set(bold.textContent, (view = new Map()));
      for (const picture of all("img", title.nextElementSibling)) {
        const label = bold ? picture.alt : `${title.textContent}: ${picture.alt}`;
        view.set(label, picture);
      }
    }
    const [place, left, right] = all("select", picker);
    const [before, after] = all("img", picker);
    const caption = picker.querySelector("figcaption");
    const fill = (select, names, wanted) => {
      const former = select.value;
      select.replaceChildren(...names.map((name) => new Option(name)));
      select.value = names.includes(former) ? former : (names.find(wanted) ?? names[0]);
    };
    const show = () => {
      const pictures = views.get(place.value);
      for (const [image, select] of [[before, left], [after, right]]) {
        image.src = pictures.get(select.value).src;
        image.alt = select.value;
      }
      const entries = [left, right].map(({ value }) => {
        const command = pictures.get(value).closest("figure").querySelector(".command");
        return command ? [value, " ", command.cloneNode(true)] : [value];
      });
      caption.replaceChildren(...entries[0], " | ", ...entries[1]);
    };
    const change = () => {
      const names = [...views.get(place.value).keys()];
      fill(left, names, (name) => name.endsWith(": warped"));
      fill(right, names, (name) => name === "target");
      show();
    };
    fill(place, [...views.keys()], () => true);
    place.addEventListener("change", change);
    for (const select of [left, right]) select.addEventListener("change", show);
    change();
  }

  // Commands name the report's folder as "."; a page that was opened as a file knows it.
  const folder = decodeURIComponent(location.pathname).replace(/\/[^/]*$/, "") || "/";
  const quoted = /^[\w@%+=:,./-]+$/.test(folder) ? folder : `'${folder.replaceAll("'", "'\"'\"'")}'`;
  if (location.protocol === "file:") {
    for (const part of all(".command")) {
      const [summary, code] = part.children;
      code.textContent = code.textContent.replace(" . ", () => ` ${quoted} `);
      summary.title = code.textContent;
    }
  }
  document.addEventListener("click", (event) => {
    const summary = event.target.closest(".command summary");
    if (!summary || summary.parentNode.open) return;
    const text = summary.nextElementSibling.textContent;
    navigator.clipboard?.writeText(text).then(() => (summary.dataset.note = " (copied)"), () => {});
  });

  // Contents: the section in view.
  const links = new Map(all("nav a").map((link) => [link.hash.slice(1), link]));
  const mark = () => {
    let current = null;
    for (const id of links.keys()) {
      if (document.getElementById(id).getBoundingClientRect().top < 120) current = id;
    }
    for (const [id, link] of links) link.classList.toggle("here", id === current);
  };
  document.addEventListener("scroll", mark, { passive: true });
  mark();

  // A link into a folded table opens it; paper shows everything.
  const open = () => {
    const target = document.getElementById(location.hash.slice(1));
    (target?.querySelector(":scope > details.fold") ?? target?.closest("details"))?.setAttribute("open", "");
  };
  window.addEventListener("hashchange", () => {
    open();
    document.getElementById(location.hash.slice(1))?.scrollIntoView();
  });
  open();
  let closed = [];
  window.addEventListener("beforeprint", () => {
    closed = all("details:not([open], .command)");
    closed.forEach((part) => (part.open = true));
  });
  window.addEventListener("afterprint", () => closed.forEach((part) => (part.open = false)));
})();
