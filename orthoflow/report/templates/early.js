"use strict";
// Runs before the first paint, so that nothing moves when the main script is loaded: shows elements that need
// scripts, and collapses the contents on narrow screens.
document.documentElement.classList.add("scripted");
document.querySelector(".contents details").open = matchMedia("(min-width: 72rem)").matches;
