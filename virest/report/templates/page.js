"use strict";
document.documentElement.classList.add("js");

for (const viewer of document.querySelectorAll("[data-viewer]")) {
  const frames = [...viewer.querySelectorAll("[data-frame]")];
  const buttons = [...viewer.querySelectorAll("[data-show]")];
  const full = viewer.querySelector("[data-full]");
  const arrows = viewer.querySelector("[data-arrows]");

  const draw = (frame) => {
    const range = frame.querySelector("[data-cut]");
    if (!range) return;
    const stage = frame.querySelector("[data-stage]");
    const compare = frame.querySelector("[data-compare]");
    // The divider runs over the part of the picture that is seen, which is all of it unless it is shown at full size.
    const width = compare.clientWidth;
    const seen = Math.min(stage.clientWidth, width);
    const cut = Math.min(stage.scrollLeft, width - seen) + (range.value / 100) * seen;
    compare.style.setProperty("--cut", `${cut}px`);
    range.setAttribute("aria-valuetext", `${range.value} percent recorded`);
  };
  const drawAll = () => frames.forEach(draw);
  const show = (chosen) => {
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
