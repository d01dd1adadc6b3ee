"use strict";
(() => {
  const study = JSON.parse(document.getElementById("study").textContent);
  const element = (id) => document.getElementById(id);
  const KEY = `userstudy-${study.study}`;
  const STRIP = 3; // views side by side; more of them turn
  const TURN = 450; // ms a view
  const REST = 250; // ms in which a tap still belongs to the choice before

  // What a browser keeps: one object a page. In IndexedDB, which says when it has it: localStorage is written seconds later, and where a
  // page asks for it before the browser has noted that the page is there, what it writes is lost without an error.
  const forgets = () => (element("memory").hidden = false);
  const answered = (request) =>
    new Promise((resolve, reject) => {
      request.onsuccess = () => resolve(request.result);
      request.onerror = () => reject(request.error);
    });
  const open = async () => {
    const request = indexedDB.open(KEY);
    request.onupgradeneeded = () => request.result.createObjectStore(KEY);
    return answered(request);
  };
  const opened = open();

  const random = (count) => {
    const numbers = crypto.getRandomValues(new Uint32Array(count));
    return [...numbers];
  };
  const fresh = () => {
    const wanted = parseInt(new URLSearchParams(location.search).get("plan"), 10);
    const plan = wanted >= 0 ? wanted : random(1)[0];
    const person = random(2).map((n) => n.toString(16).padStart(8, "0")).join("");
    return { person, plan: plan % study.plans.length, made: [], saved: 0 };
  };
  const read = async () => {
    try {
      const kept = await answered((await opened).transaction(KEY).objectStore(KEY).get(KEY));
      if (study.plans[kept?.plan]?.length >= kept.made.length) return kept;
    } catch {
      forgets(); // a private window may refuse it
    }
    return fresh();
  };
  let state;
  const keep = async () => {
    try {
      const transaction = (await opened).transaction(KEY, "readwrite");
      transaction.objectStore(KEY).put(state, KEY);
      await new Promise((resolve, reject) => {
        transaction.oncomplete = resolve;
        transaction.onabort = reject;
      });
    } catch {
      forgets();
    }
  };
  const plan = () => study.plans[state.plan];

  // Seconds of a choice, while it can be seen.
  let spent = 0;
  let since = null;
  const clock = (runs) => {
    if (since !== null) spent += performance.now() - since;
    since = runs ? performance.now() : null;
  };
  document.addEventListener("visibilitychange", () => clock(!document.hidden && at === "trial"));

  let at = "reading";
  const go = (name) => {
    at = name;
    for (const id of ["start", "trial", "paused", "end"]) element(id).hidden = id !== name;
    clock(name === "trial" && !document.hidden);
    scrollTo(0, 0);
  };

  // Views: a strip of all, or one that turns. All three places show the same.
  let view = 0;
  let step = 1;
  let turning = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  let places = [];
  const image = (name) => Object.assign(new Image(), { src: study.pictures[name], alt: "" });
  const turn = (number) => {
    view = number;
    element("angle").value = view;
    for (const [strip, images] of places) strip.replaceChildren(images[view]);
  };
  const show = (parts) => {
    const several = parts[0][1].length > STRIP;
    places = parts.map(([id, names]) => [element(id).querySelector(".strip"), names.map(image)]);
    document.body.classList.toggle("turning", several);
    element("turn").hidden = !several;
    element("angle").max = parts[0][1].length - 1;
    if (several) turn(0);
    else for (const [strip, images] of places) strip.replaceChildren(...images);
  };
  setInterval(() => {
    if (at !== "trial" || !turning || element("turn").hidden) return;
    const last = places[0][1].length - 1;
    if (view + step < 0 || view + step > last) step = -step;
    turn(view + step);
  }, TURN);
  const play = (runs) => {
    turning = runs;
    element("play").textContent = turning ? "Stop" : "Turn";
  };
  play(turning);
  element("play").addEventListener("click", () => play(!turning));
  element("angle").addEventListener("input", (event) => {
    play(false);
    turn(Number(event.target.value));
  });

  let ready = 0;
  const next = () => {
    const number = state.made.length;
    if (number >= plan().length) return finish();
    const [item, question, left, right] = plan()[number];
    const scene = study.items[item];
    element("progress").max = plan().length;
    element("progress").value = number;
    element("place").textContent = `${number + 1} of ${plan().length}`;
    element("back").disabled = number === 0;
    element("question").textContent = study.questions[question];
    element("instruction").textContent = scene.instruction;
    show([["before", scene.before], ["left", scene.sides[left]], ["right", scene.sides[right]]]);
    spent = 0;
    since = null;
    ready = performance.now() + (number ? REST : 0);
    go("trial");
  };
  const choose = async (side) => {
    if (at !== "trial" || performance.now() < ready) return;
    clock(false);
    state.made.push([side, Math.round(spent)]);
    const button = element(side);
    button.classList.add("chosen");
    at = "between";
    await Promise.all([keep(), new Promise((shown) => setTimeout(shown, 120))]);
    button.classList.remove("chosen");
    next();
  };
  const back = () => {
    if (at !== "trial" || !state.made.length) return;
    state.made.pop();
    keep();
    next();
  };
  const pause = () => {
    if (at !== "trial") return;
    element("done").textContent = `${state.made.length} of ${plan().length} choices made.`;
    go("paused");
  };
  const resume = () => go("trial");
  const finish = () => {
    element("saved").textContent = "";
    go("end");
  };
  const begin = () => {
    keep();
    next();
  };

  // The answers' file; it needs no page to be read.
  const answers = () => ({
    format: study.format,
    study: study.study,
    title: study.title,
    person: state.person,
    plan: state.plan,
    planned: plan().length,
    choices: state.made.map(([side, ms], number) => {
      const [item, question, left, right] = plan()[number];
      const { scene, edit, seed } = study.items[item];
      return { scene, edit, seed, question, left, right, chosen: side, seconds: ms / 1000 };
    }),
  });
  const text = () => `${JSON.stringify(answers(), null, 1)}\n`;
  const save = () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text()], { type: "application/json" }));
    link.download = `answers-${state.person}.json`;
    document.body.append(link);
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 60000);
    state.saved = state.made.length;
    keep();
    element("saved").textContent = `Saved as ${link.download}.`;
  };
  const copy = async () => {
    try {
      await navigator.clipboard.writeText(text());
      element("saved").textContent = "Copied.";
    } catch {
      element("saved").textContent = "This browser does not allow it; save the file instead.";
    }
  };
  const again = () => {
    const unsaved = state.saved < state.made.length;
    if (unsaved && !confirm("These answers are not saved, and will be lost. Go on?")) return;
    state = fresh();
    keep();
    start();
  };
  const start = () => {
    const [done, all] = [state.made.length, plan().length];
    const minutes = Math.max(1, Math.round((all - done) / 7));
    const left = `about ${minutes} minute${minutes > 1 ? "s" : ""}`;
    element("count").textContent = done
      ? `${done} of ${all} choices are made; the others take ${left}.`
      : `${all} choices, ${left}.`;
    element("begin").textContent = done ? "Go on" : "Begin";
    if (done >= all) return finish();
    go("start");
  };

  for (const side of ["left", "right"]) element(side).addEventListener("click", () => choose(side));
  for (const button of document.querySelectorAll(".save")) button.addEventListener("click", save);
  const actions = { back, pause, resume, begin, copy, again };
  for (const [id, act] of Object.entries(actions)) element(id).addEventListener("click", act);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    if (event.target.id === "angle") return;
    // A button that has the focus does its own work.
    if (event.key === "Enter" && event.target.tagName === "BUTTON") return;
    const trial = {
      ArrowLeft: () => choose("left"),
      ArrowRight: () => choose("right"),
      Backspace: back,
      p: pause,
      P: pause,
      Escape: pause,
    };
    const screens = { trial, start: { Enter: begin }, paused: { Enter: resume, p: resume, P: resume, Escape: resume } };
    const act = screens[at]?.[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
  read().then((found) => {
    state = found;
    start();
  });
})();
