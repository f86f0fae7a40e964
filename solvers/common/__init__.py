"""Tools shared by solvers: conversion of QPs, sequences of QPs, lists of backends."""
