/*! kpc-player, Apache-2.0. Contains fzstd, Copyright (c) 2020 Arjun Barrett, MIT License. */
"use strict";(()=>{})();
