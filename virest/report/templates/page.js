"use strict";
document.documentElement.classList.add("js");

for (const viewer of document.querySelectorAll("[data-viewer]")) {
  const frames = [...viewer.querySelectorAll("[data-frame]")];
  const buttons = [...viewer.querySelectorAll("[data-show]")];
  const full = viewer.querySelector("[data-full]");
  const arrows = viewer.querySelector("[data-arrows]");
  const flick = viewer.querySelector("[data-flicker]");

  const draw = (frame) => {
    const range = frame.querySelector("[data-cut]");
    if (!range) return;
    const stage = frame.querySelector("[data-stage]");
    const compare = frame.querySelector("[data-compare]");
    // The divider spans the visible part of the picture: all of it, except at full size.
    const width = compare.clientWidth;
    const seen = Math.min(stage.clientWidth, width);
    const cut = Math.min(stage.scrollLeft, width - seen) + (range.value / 100) * seen;
    compare.style.setProperty("--cut", `${cut}px`);
    range.setAttribute("aria-valuetext", `${range.value} percent recorded`);
  };
  const drawAll = () => frames.forEach(draw);
  let cut = "50";
  let flicker = 0;
  const cutAll = (value) => {
    for (const range of viewer.querySelectorAll("[data-cut]")) range.value = value;
    drawAll();
  };
  const show = (chosen) => {
    const shown = frames.find((frame) => !frame.hidden)?.querySelector("[data-cut]");
    if (shown && !flicker) cut = shown.value;
    const range = frames[chosen].querySelector("[data-cut]");
    if (range && !flicker) range.value = cut;  // keep the divider where the reader put it
    frames.forEach((frame, k) => { frame.hidden = k !== chosen; });
    buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(k === chosen)));
    draw(frames[chosen]);
  };

  for (const frame of frames) {
    const range = frame.querySelector("[data-cut]");
    const stage = frame.querySelector("[data-stage]");
    if (!range) continue;
    range.addEventListener("input", () => draw(frame));
    stage.addEventListener("scroll", () => draw(frame), { passive: true });
    const drag = (event) => {
      const box = stage.getBoundingClientRect();
      const compare = frame.querySelector("[data-compare]").getBoundingClientRect();
      const left = Math.max(box.left, compare.left);
      const seen = Math.min(box.right, compare.right) - left;
      range.value = Math.round((100 * (event.clientX - left)) / seen);
      draw(frame);
    };
    stage.addEventListener("pointerdown", (event) => {
      if (event.button !== 0 || (full.checked && event.pointerType === "touch")) return;
      if (!event.target.closest("[data-compare]")) return;
      stage.setPointerCapture(event.pointerId);
      drag(event);
    });
    stage.addEventListener("pointermove", (event) => {
      if (stage.hasPointerCapture(event.pointerId)) drag(event);
    });
  }
  buttons.forEach((button, k) => button.addEventListener("click", () => show(k)));
  const strip = () => buttons.forEach((button, k) => {
    const image = frames[k].querySelector(".after img") || frames[k].querySelector("img");
    if (!image || !image.naturalWidth || button.querySelector("canvas")) return;
    const canvas = document.createElement("canvas");
    canvas.height = 48;
    canvas.width = Math.round((48 * image.naturalWidth) / image.naturalHeight);
    canvas.setAttribute("aria-hidden", "true");
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    button.prepend(canvas);
  });
  window.addEventListener("load", strip);
  if (flick) flick.addEventListener("change", () => {
    clearInterval(flicker);
    flicker = 0;
    if (!flick.checked) { cutAll(cut); return; }
    const shown = frames.find((frame) => !frame.hidden)?.querySelector("[data-cut]");
    if (shown) cut = shown.value;
    let recorded = false;
    flicker = setInterval(() => { recorded = !recorded; cutAll(recorded ? "100" : "0"); }, 600);
  });
  arrows.addEventListener("change", () => viewer.classList.toggle("no-arrows", !arrows.checked));
  full.addEventListener("change", () => {
    viewer.classList.toggle("full", full.checked);
    for (const stage of viewer.querySelectorAll("[data-stage]")) {
      if (full.checked) stage.tabIndex = 0; else stage.removeAttribute("tabindex");
    }
    drawAll();
  });
  window.addEventListener("resize", drawAll);
  window.addEventListener("load", drawAll);
  show(0);
}
