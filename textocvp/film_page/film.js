// Films of `textocvp.film_page.film_data`, all of a page at the same moment of one clock.
const clock = {
  moment: 0, count: 1, rate: 8, films: new Set(), listeners: new Set(),
  playing: !matchMedia("(prefers-reduced-motion: reduce)").matches,
  show(moment) {
    this.moment = moment;
    for (const draw of [...this.films, ...this.listeners]) draw(moment);
  },
};
// The last moment stays for a second.
let waited = 0;
setInterval(() => {
  if (!clock.playing || clock.count < 2) return;
  const atEnd = clock.moment >= clock.count - 1;
  if (atEnd && ++waited < clock.rate) return;
  waited = 0;
  clock.show(atEnd ? 0 : clock.moment + 1);
}, 1000 / clock.rate);

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function player() {
  const toggle = element("button", {type: "button"});
  const slider = element("input", {type: "range", min: 0, value: 0, ariaLabel: "moment"});
  const said = element("output");
  const update = () => {
    toggle.textContent = clock.playing ? "pause" : "play";
    slider.max = clock.count - 1;
    slider.value = clock.moment;
    said.textContent = `frame ${clock.moment} of ${clock.count - 1}`;
  };
  toggle.onclick = () => { clock.playing = !clock.playing; update(); };
  slider.oninput = () => { clock.playing = false; clock.show(Number(slider.value)); };
  clock.listeners.add(update);
  update();
  return element("div", {className: "player"}, toggle, slider, said);
}

function decodeRuns(runs, length) {
  const labels = new Uint8Array(length);
  for (let i = 0, at = 0; i < runs.length; i += 2) labels.fill(runs[i], at, at += runs[i + 1]);
  return labels;
}

function filmCard(film, title = film.text) {
  const {width, height, count} = film, pixels = width * height;
  const labels = decodeRuns(film.runs, pixels * count);
  const names = new Map(film.slots.map(one => [one.slot, one.name]));
  const card = element("article", {className: "film"}, element("h3", {textContent: title}));
  const panels = card.appendChild(element("div", {className: "panels"}));
  const rows = new Map();
  let chosen = null;

  function panel(caption) {
    const canvas = element("canvas", {width, height, role: "img", ariaLabel: `${caption}: ${title}`});
    const below = element("figcaption", {textContent: caption});
    panels.append(element("figure", {}, canvas, below));
    canvas.onpointermove = event => {
      const box = canvas.getBoundingClientRect();
      const x = Math.floor((event.clientX - box.left) / box.width * width);
      const y = Math.floor((event.clientY - box.top) / box.height * height);
      const moment = Math.min(clock.moment, count - 1);
      choose(labels[moment * pixels + Math.max(0, Math.min(pixels - 1, y * width + x))] ?? null);
    };
    canvas.onpointerleave = () => choose(null);
    return {context: canvas.getContext("2d"), below, caption};
  }
  function picture(caption, url) {
    const {context, below} = panel(caption), image = new Image();
    let ready = false;
    const draw = moment => ready && context.drawImage(image, 0, moment * height, width, height, 0, 0, width, height);
    image.onload = () => { ready = true; draw(Math.min(clock.moment, count - 1)); };
    image.src = url;
    return {draw, below};
  }

  const drawn = [picture("imagined", film.frames)];
  const slots = panel("slots");
  if (film.real) drawn.push(picture("what happened", film.real), picture("difference", film.apart));
  const apart = drawn[2]?.below;

  function drawSlots(moment) {
    const data = slots.context.createImageData(width, height);
    for (let i = 0; i < pixels; i++) {
      const slot = labels[moment * pixels + i];
      const light = chosen === null || slot === chosen ? 1 : .25;
      for (let c = 0; c < 3; c++) data.data[4 * i + c] = film.colors[slot][c] * light;
      data.data[4 * i + 3] = 255;
    }
    slots.context.putImageData(data, 0, 0);
    slots.below.textContent = "slots" + (chosen === null ? "" : ": " + (names.get(chosen) ?? `slot ${chosen}`));
  }
  function choose(slot) {
    if (slot === chosen) return;
    rows.get(chosen)?.classList.remove("chosen");
    chosen = slot;
    rows.get(chosen)?.classList.add("chosen");
    drawSlots(Math.min(clock.moment, count - 1));
  }
  function name(one) {
    const button = element("button", {type: "button", className: "name", textContent: one.name});
    button.style.setProperty("--dot", `rgb(${film.colors[one.slot].join(" ")})`);
    button.onfocus = button.onpointerenter = button.onclick = () => choose(one.slot);
    button.onblur = button.onpointerleave = () => choose(null);
    return button;
  }

  const cells = [];
  if (film.attention) {
    const head = element("tr", {}, element("td"));
    for (const word of film.words) head.append(element("th", {scope: "col", textContent: word}));
    const body = element("tbody");
    for (const one of film.slots) {
      const row = element("tr", {}, element("th", {scope: "row"}, name(one)));
      film.words.forEach((_, word) => {
        const cell = row.appendChild(element("td"));
        cells.push({cell, slot: one.slot, word});
      });
      rows.set(one.slot, row);
      body.append(row);
    }
    const table = element("table", {}, element("caption", {textContent: "attention to each word now, in percent"}),
      element("thead", {}, head), body);
    card.append(element("div", {className: "attention", tabIndex: 0, ariaLabel: "attention"}, table));
  } else {
    const line = card.appendChild(element("p", {className: "quiet"}));
    for (const one of film.slots) { const button = name(one); rows.set(one.slot, button); line.append(button, " "); }
  }

  function draw(now) {
    const moment = Math.min(now, count - 1);
    for (const one of drawn) one.draw(moment);
    drawSlots(moment);
    for (const {cell, slot, word} of cells) {
      const percent = film.attention[moment][slot][word];
      cell.textContent = percent;
      cell.style.background = `rgb(var(--accent) / ${percent / 200})`;
    }
    if (apart) apart.textContent = `difference: ${film.apart_percent[moment]} % on average`;
  }
  clock.films.add(draw);
  clock.count = Math.max(clock.count, count);
  card.forget = () => clock.films.delete(draw);
  clock.show(clock.moment);
  return card;
}
