for (const slider of document.querySelectorAll(".view input")) {
  const over = slider.closest(".view").querySelector(".over");
  const show = () => { over.style.clipPath = `inset(0 ${100 - slider.value}% 0 0)`; };
  slider.addEventListener("input", show);
  show();
}
